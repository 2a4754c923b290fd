"""`python -m fusiond`: the command line."""

from fusiond.commands.app import main

if __name__ == "__main__":
    main()
