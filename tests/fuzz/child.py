"""One process of libFuzzer over one target: `python -m tests.fuzz.child nmea -runs=1000 FOLDER`.

Only the target's own modules are traced. Each branch of a traced module costs 80 ns a passage: that
is most of a run where the sums over each byte, or the splitter below a decoder, are traced as well,
and a decoder's corpus need not tell one split of the line from another.
"""

from __future__ import annotations

import gc
import importlib
import sys
from pathlib import Path

import atheris

from tests.fuzz.parsers import PARSERS
from tests.places import REPOSITORY


def main() -> None:
    name, *flags = sys.argv[1:]
    traced = PARSERS[name].modules
    packages = {module.partition(".")[0] for module in traced}
    # atheris takes whole packages; compiled functions cannot be traced at all.
    others = [module for package in packages for module in _modules(package)]
    others = [module for module in others if module not in traced]
    plain = {module: importlib.import_module(module) for module in traced}
    for module in traced:
        package, _, own = module.rpartition(".")
        del sys.modules[module]
        delattr(sys.modules[package], own)
    with atheris.instrument_imports(include=list(traced), exclude=others):
        from tests.fuzz.targets import TARGETS, UNTRACED  # noqa: PLC0415
    for module, twin in plain.items():
        probed = vars(sys.modules[module]).items()
        UNTRACED.update({v: vars(twin)[k] for k, v in probed if isinstance(v, type)})
    # What is loaded stays: thousands of collections a minute need not look through it.
    gc.freeze()
    # libFuzzer starts itself anew where it merges.
    itself = f"{sys.executable} -m tests.fuzz.child {name}"
    atheris.Setup([itself, *flags], TARGETS[name])
    atheris.Fuzz()


def _modules(package: str) -> list[str]:
    paths = (path.relative_to(REPOSITORY) for path in Path(REPOSITORY, package).rglob("*.py"))
    dotted = [".".join(path.with_suffix("").parts) for path in paths]
    return [name.removesuffix(".__init__") for name in dotted]


if __name__ == "__main__":
    main()
