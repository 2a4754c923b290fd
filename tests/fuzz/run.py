"""Fuzzes one target, or each in turn, with atheris: `python -m tests.fuzz.run nmea --runs 100000`.

What it finds new stays in `.fuzz/TARGET`; an input that breaks a promise is written to
`.fuzz/TARGET-crash-...`. Inputs worth keeping belong into `tests/fuzz/corpus/TARGET`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import atheris

# Compiled by numba, which cannot read instrumented code: imported before the rest is.
import fusiond.files.fixed_decimal  # noqa: F401

CORPUS = Path(__file__).with_name("corpus")
FOUND = Path(".fuzz")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", nargs="?", help="default: all, in turn")
    parser.add_argument("--runs", type=int, default=100_000)
    options = parser.parse_args()
    with atheris.instrument_imports(include=["drivers", "fusiond.outputs", "fusiond.files.tables"]):
        from tests.fuzz.targets import TARGETS  # noqa: PLC0415
    if options.target is None:  # libFuzzer ends its process, so each target has one
        command = [sys.executable, "-m", "tests.fuzz.run", "--runs", str(options.runs)]
        return max(subprocess.call([*command, name]) for name in TARGETS)
    if options.target not in TARGETS:
        parser.error(f"no target {options.target!r}: {', '.join(TARGETS)}")
    found = FOUND / options.target
    found.mkdir(parents=True, exist_ok=True)
    flags = [f"-runs={options.runs}", "-max_len=2048", "-print_final_stats=1", "-verbosity=0"]
    flags += [f"-artifact_prefix={FOUND}/{options.target}-"]
    atheris.Setup(
        [sys.argv[0], *flags, str(found), str(CORPUS / options.target)], TARGETS[options.target]
    )
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
