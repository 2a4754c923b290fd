"""Process of the daemon: `python -m fusiond.live CONFIG [DIR]`; with DIR it records everything
there.

`fusiond run` parses the command line, then replaces itself by this program under the same process
id. The parser's 2 MB would otherwise stay in memory as long as the daemon runs.
"""

from __future__ import annotations

import gc
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusiond.configuration.schema import Config

COLLECT_AFTER_IMPORTS, COLLECT_AFTER = 1_000_000, 50_000
"""Objects made since the last collection: imports make half a million, and are looked through once
they are done; a filter at work makes the other in minutes, `fusiond.live.tick_scheduler` in
none."""


def main(path: Path, record: Path | None = None) -> None:
    """Serve until SIGTERM. A mistake in the configuration is printed to standard error, with exit
    status 78."""
    gc.set_threshold(COLLECT_AFTER_IMPORTS)
    from fusiond.configuration.load import EXIT_CONFIG, ConfigError, load_config  # noqa: PLC0415

    def configuration() -> Config:
        return recorded(load_config(path), record)

    try:
        config = configuration()
    except ConfigError as error:
        print(error, file=sys.stderr)
        sys.exit(EXIT_CONFIG)
    from fusiond.navigation.compiled import gathered, needed  # noqa: PLC0415 - takes seconds

    with gathered() as missing:
        from fusiond.live.daemon import run_daemon  # noqa: PLC0415
        from fusiond.navigator.kernel_widths import kernel_widths  # noqa: PLC0415
        from fusiond.navigator.navigator import Navigator  # noqa: PLC0415

        widths = None
        with suppress(ConfigError):  # the daemon reports it
            widths = kernel_widths(Navigator(config))
    # Free the 2 MB that imports left in cycles, and exempt all live objects from later collections.
    gc.collect()
    gc.freeze()
    gc.set_threshold(COLLECT_AFTER)
    run_daemon(config, path, configuration, needed(missing, widths))


def recorded(config: Config, folder: Path | None) -> Config:
    """Configuration that records everything into `folder`; unchanged without one."""
    if folder is None:
        return config
    update = {"directory": folder.absolute(), "when": "always"}
    return config.model_copy(update={"recording": config.recording.model_copy(update=update)})


if __name__ == "__main__":
    try:
        main(*map(Path, sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        # At exit the interpreter would examine all imported objects twice: a quarter of a second to
        # free memory that ends with the process.
        gc.freeze()
