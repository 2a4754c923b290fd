"""The command line as a program: `python -m fusiond`, and `fusiond`."""

import gc

gc.set_threshold(1_000_000)  # as `main` does, before what it is made of is imported

from fusiond.commands.app import main  # noqa: E402

if __name__ == "__main__":
    main()
