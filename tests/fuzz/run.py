"""Fuzzes parsers side by side: `python -m tests.fuzz.run --runs 10000000 nmea rdss_text`.

Each has a process of its own, as many at once as there are processors. After its runs with short
inputs come some with long ones, for what buffers and lengths decide. What it finds new stays in
`.fuzz/TARGET`, minimised; what reaches a branch that nothing in `tests/fuzz/corpus/TARGET` does is
added there. An input that breaks a promise, or takes a minute, is written to `.fuzz/TARGET-...`.
Interrupted, it tells what was done until then; nothing found is lost.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.fuzz.parsers import PARSERS

HERE = Path(__file__).parent
CORPUS, DICTIONARIES = HERE / "corpus", HERE / "dictionaries"
FOUND = Path(".fuzz")
LONGEST = 9000
"""Bytes of a long input: the longest frame of all, UBX, with something on either side."""
SHORT_PER_LONG = 1000
HUNG_S = 60
RUNS_A_PROCESS = 1_000_000
"""atheris keeps 0.6 kB of each run of `csv`, which alone keeps nothing: 2 GB, the fuzzer's limit,
after three million."""
_EXECUTED = re.compile(r"stat::number_of_executed_units:\s+(\d+)")
_HEADINGS = ("parser", "runs", "long", "seconds", "runs/s", "found", "kept", "corpus", "crashes")


class Fuzzing:
    """Of one parser: what was run, what came of it."""

    def __init__(self, name: str, runs: int) -> None:
        self.name, self._runs = name, runs
        self.done, self.done_long, self.seconds = 0, 0, 0.0
        self.kept = 0
        self._found, self._corpus = FOUND / name, CORPUS / name
        self._found.mkdir(parents=True, exist_ok=True)
        self._child: subprocess.Popen[str] | None = None
        self._stopped = False

    def run(self) -> None:
        began = time.monotonic()
        while (runs := min(self._runs - self.done, RUNS_A_PROCESS)) > 0:
            done = self._fuzz(runs, [f"-max_len={PARSERS[self.name].length}"])
            self.done += done
            if self._stopped or done < runs:  # by a crash
                break
        if not (self._stopped or self.crashes):
            long = [f"-max_len={LONGEST}", "-len_control=0"]
            self.done_long = self._fuzz(max(1, self._runs // SHORT_PER_LONG), long)
        self.seconds = time.monotonic() - began
        self._minimise()

    def stop(self) -> None:
        self._stopped = True
        if self._child is not None:
            self._child.send_signal(signal.SIGTERM)

    @property
    def crashes(self) -> list[Path]:
        """Inputs of this and of earlier runs that nobody has removed."""
        return sorted(FOUND.glob(f"{self.name}-*-*"))

    @property
    def row(self) -> tuple[str, ...]:
        corpus = list(self._corpus.iterdir())
        size = sum(path.stat().st_size for path in corpus)
        rate = (self.done + self.done_long) / self.seconds if self.seconds else 0.0
        found = len(list(self._found.iterdir()))
        numbers = (self.done, self.done_long, round(self.seconds), round(rate), found, self.kept)
        crashes = " ".join(map(str, self.crashes)) or "none"
        return (self.name, *map(str, numbers), f"{len(corpus)}, {size} B", crashes)

    def _fuzz(self, runs: int, flags: list[str]) -> int:
        """How many inputs were run. A run that did not come to its end is known by its crash."""
        flags = [*flags, f"-runs={runs}", f"-timeout={HUNG_S}", "-print_final_stats=1"]
        flags += ["-verbosity=0", f"-artifact_prefix={FOUND}/{self.name}-"]
        dictionary = DICTIONARIES / f"{self.name}.dict"
        if dictionary.exists():
            flags.append(f"-dict={dictionary}")
        said = self._libfuzzer([*flags, str(self._found), str(self._corpus)])
        executed = _EXECUTED.search(said)
        return int(executed[1]) if executed else 0

    def _minimise(self) -> None:
        before = len(list(self._corpus.iterdir()))
        whole = [f"-max_len={LONGEST}", "-set_cover_merge=1"]
        branches = ["-use_counters=0", "-use_cmp=0"]
        self._libfuzzer([*whole, *branches, str(self._corpus), str(self._found)])
        self.kept = len(list(self._corpus.iterdir())) - before
        fewer = FOUND / f"{self.name}.fewer"
        shutil.rmtree(fewer, ignore_errors=True)
        fewer.mkdir()
        self._libfuzzer([f"-max_len={LONGEST}", "-merge=1", str(fewer), str(self._found)])
        if any(fewer.iterdir()):
            shutil.rmtree(self._found)
            fewer.rename(self._found)

    def _libfuzzer(self, arguments: list[str]) -> str:
        command = [sys.executable, "-m", "tests.fuzz.child", self.name, *arguments]
        # In a session of its own: an interrupt from the terminal is this process's to hand on.
        self._child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            errors="replace", start_new_session=True,
        )  # fmt: skip
        said = self._child.communicate()[0]
        (FOUND / f"{self.name}.log").write_text(said, errors="replace")
        return said


def _table(rows: list[tuple[str, ...]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", help=f"default: all; {', '.join(PARSERS)}")
    parser.add_argument("--runs", type=int, default=100_000, help="of short inputs, each")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="at once")
    options = parser.parse_args()
    for name in options.targets:
        if name not in PARSERS:
            parser.error(f"no target {name!r}: {', '.join(PARSERS)}")
    # A service manager or a shell's background job interrupts by another signal than a terminal.
    for one in (signal.SIGINT, signal.SIGTERM):
        signal.signal(one, signal.default_int_handler)
    every = [Fuzzing(name, options.runs) for name in options.targets or PARSERS]
    with ThreadPoolExecutor(options.jobs) as pool:
        running = [pool.submit(one.run) for one in every]
        try:
            for each in running:
                each.result()
        except KeyboardInterrupt:
            for fuzzing, each in zip(every, running, strict=True):
                if not each.cancel():
                    fuzzing.stop()
    print(_table([_HEADINGS, *(one.row for one in every)]))
    failed = any(one.crashes or not one.done for one in every)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
