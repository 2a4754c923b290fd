"""A Debian package of fusiond: a virtual environment below /opt/fusiond, and what a system needs.

    python tools/debian_package.py [--out DIR] [--python /usr/bin/python3] [--requirements FILE]

`make deb` does it. The locked dependencies are installed as published, with their hashes; nothing
is built but fusiond's own wheel. Their own tests and what only a debugger reads are left out. The
package holds for the Python that the environment was made with. Nothing of this machine is changed.
"""

from __future__ import annotations

import argparse
import gzip
import os
import shutil
import subprocess
import sys
from email.utils import formatdate
from pathlib import Path

from tools import licences, man_pages, prebuilt

REPOSITORY = Path(__file__).resolve().parents[1]
HOME = "opt/fusiond"
VENV = f"{HOME}/.venv"
SOURCES = (
    *("pyproject.toml", "README.md", "LICENSE", licences.FILE.name),
    *("fusiond", "drivers", "config"),
)
# As Debian's own tools ask; a package that is given away wants an address that is read.
MAINTAINER = "{} <{}>".format(
    os.environ.get("DEBFULLNAME", "The fusiond authors"),
    os.environ.get("DEBEMAIL", "fusiond@example.org"),
)
# Without what would let the builder's own packages in, or leave its paths in what is compiled.
ENVIRONMENT = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
ENVIRONMENT["PYTHONDONTWRITEBYTECODE"] = "1"
CONFFILES = ("/etc/fusiond/vehicle.toml",)
BUILDERS = ("setuptools", "setuptools-*.dist-info", "_distutils_hack", "distutils-precedence.pth")
"""What the lock has for building the wheel, on this machine; on a vehicle nothing imports it."""
FOR_COMPILERS = {".a", ".c", ".cpp", ".h", ".hpp", ".pxd", ".pyi", ".pyx"}
"""Sources, headers and stubs: read by compilers of extensions and by type checkers."""

CONTROL = """\
Package: fusiond
Version: {version}-1
Section: science
Priority: optional
Architecture: {architecture}
Maintainer: {maintainer}
Installed-Size: {size_kib}
Depends: python3 (>= {python}), python3 (<< {next_python}), libc6 (>= 2.28), systemd
Recommends: mosquitto, can-utils, udev
Description: inertial navigation aided by BeiDou RDSS and GNSS
 A daemon for a vehicle computer. It reads an IMU from a CAN bus, a BeiDou RDSS
 user terminal and a GNSS receiver, and publishes position, velocity and
 attitude over MQTT, each with its sigma and with a statistical verdict on it.
 .
 Everything Python lives in a virtual environment below /opt/fusiond.
"""
POSTINST = """\
#!/bin/sh
set -e
if [ "$1" = configure ]; then
    systemd-sysusers fusiond.conf
    if [ -d /run/systemd/system ]; then
        systemctl daemon-reload
        udevadm control --reload || true
        # An update goes on with the new code; a first installation waits for its configuration.
        if [ -n "$2" ]; then systemctl try-restart fusiond.service || true; fi
    fi
fi
"""
PRERM = """\
#!/bin/sh
set -e
if [ "$1" = remove ]; then
    units="fusiond-gpsd.socket fusiond.service"
    if [ -d /run/systemd/system ]; then systemctl stop $units || true; fi
    systemctl --quiet disable $units || true
fi
"""
POSTRM = """\
#!/bin/sh
set -e
if [ -d /run/systemd/system ]; then systemctl daemon-reload || true; fi
if [ "$1" = purge ]; then
    rm -rf /var/lib/fusiond /var/cache/fusiond
    rmdir /etc/fusiond 2>/dev/null || true
    if getent passwd fusiond >/dev/null; then userdel fusiond || true; fi
fi
# No package owns it, so that dpkg takes it away with the last that has files there.
[ -d /opt ] || mkdir -m 755 /opt
"""
COPYRIGHT = """\
Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/
Upstream-Name: fusiond

Files: *
Copyright: The fusiond authors
License: Apache-2.0

Files: opt/fusiond/.venv/lib/*
Copyright: their authors
License: as-stated
 Each package below /opt/fusiond/.venv is on the terms that
 /usr/share/doc/fusiond/{third_party}.gz names; their texts are in the package's
 .dist-info folder or in that file.

Files: opt/fusiond/.venv/lib/python*/site-packages/can/*
Copyright: the authors of python-can
License: LGPL-3.0-only
 On Debian systems the text is in /usr/share/common-licenses/LGPL-3, that of the
 GNU General Public License, version 3, in /usr/share/common-licenses/GPL-3.

License: Apache-2.0
 On Debian systems the text is in /usr/share/common-licenses/Apache-2.0.
"""
# What Debian asks of its own archive and what published wheels are not.
OVERRIDES = """\
# A vendor's package: Debian's archive has no say in /opt.
fusiond: dir-or-file-in-opt
# The daemon's user may not write there: without them every start would compile them.
fusiond: package-installs-python-pycache-dir
# Wheels as published on PyPI, whose hashes are locked.
fusiond: unstripped-binary-or-object [opt/fusiond/.venv/lib/python3.*/site-packages/*.libs/*]
fusiond: embedded-library
fusiond: custom-library-search-path
fusiond: shared-library-is-executable
fusiond: library-not-linked-against-libc
fusiond: arch-dependent-file-in-usr-share
"""


class Tree:
    """The package's files, as they will lie below `/`."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def write(self, path: str, text: str | bytes, mode: int = 0o644) -> Path:
        """Write a file; its folders are made."""
        target = self.root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(text.encode() if isinstance(text, str) else text)
        target.chmod(mode)
        return target

    def copy(self, source: str, path: str) -> None:
        """Copy a file of the repository."""
        self.write(path, (REPOSITORY / source).read_bytes())

    def packed(self, path: str, text: str) -> None:
        """A file that Debian wants compressed, without a time in it."""
        self.write(f"{path}.gz", gzip.compress(text.encode(), 9, mtime=0))

    def link(self, path: str, to: str) -> None:
        target = self.root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(to)


def run(*command: object, **options: object) -> str:
    """A command's standard output; its own words and an end where it fails."""
    done = subprocess.run(
        [str(part) for part in command],
        check=False,
        text=True,
        stdout=subprocess.PIPE,
        **{"env": ENVIRONMENT, **options},  # type: ignore[call-overload]
    )
    if done.returncode:
        sys.exit(f"{command[0]} ended with {done.returncode}")
    return str(done.stdout)


def environment(tree: Tree, python: str, requirements: Path, work: Path) -> None:
    """The virtual environment with the locked dependencies and fusiond, as it will lie in /opt."""
    venv = tree.root / VENV
    run(python, "-m", "venv", "--without-pip", venv)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input")
    install = (*pip, "--python", venv / "bin/python", "install", "--quiet", "--no-compile")
    run(*install, "--require-hashes", "-r", requirements)
    source = work / "source"  # a build leaves folders behind
    for name in SOURCES:
        if (REPOSITORY / name).is_dir():
            shutil.copytree(REPOSITORY / name, source / name, symlinks=True)
        else:
            source.mkdir(exist_ok=True)
            shutil.copy(REPOSITORY / name, source / name)
    wheels = work / "wheels"
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels)
    run(*pip, "wheel", *options, source)
    run(*install, "--no-deps", next(wheels.glob("*.whl")))
    shutil.rmtree(venv / "include", ignore_errors=True)
    packages = next(venv.glob("lib/python*/site-packages"))
    # Before the environment is made lighter: compiling takes what a vehicle then does without.
    prebuilt.build(packages / "fusiond", venv / "bin/python")
    lighten(venv)
    if found := licences.faults(licences.packages(packages)):
        sys.exit("\n".join(found))
    _settle(venv, str(tree.root))
    stage = ("-s", tree.root, "-p", "/")
    run(venv / "bin/python", "-m", "compileall", "-q", *stage, venv / "lib")


def lighten(venv: Path) -> None:
    """Leave out what builds wheels (setuptools, 8 MB with its bytecode) and extensions (4 MB), the
    packages' own tests (37 MB) and the symbols that only a debugger reads (45 MB), and their
    programs, which nobody calls.

    Libraries in `*.libs` stay as they are: their loading segments were moved when the wheels were
    made, which strip does not always survive.
    """
    for path in (venv / "bin").iterdir():
        if path.name != "fusiond" and not path.name.startswith("python"):
            path.unlink()
    packages = next(venv.glob("lib/python*/site-packages"))
    for pattern in BUILDERS:
        for path in packages.glob(pattern):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    for folder in sorted(packages.rglob("tests")):
        if folder.is_dir():
            shutil.rmtree(folder)
    for path in packages.rglob("*"):
        if path.suffix in FOR_COMPILERS and path.is_file():
            path.unlink()
    libraries = [p for p in packages.rglob("*.so") if not p.parent.name.endswith(".libs")]
    run("strip", "--strip-unneeded", "--preserve-dates", *libraries)


def _settle(venv: Path, root: str) -> None:
    """Take the building place out of what names it: the first lines of programs, the activation."""
    for path in [venv / "pyvenv.cfg", *(venv / "bin").iterdir()]:
        if path.is_symlink() or not path.is_file():
            continue
        data = path.read_bytes()
        if root.encode() in data:
            path.write_bytes(data.replace(root.encode(), b""))
    for package in venv.glob("lib/python*/site-packages/*.dist-info"):
        for name in ("direct_url.json", "RECORD"):  # name the building place, or what was there
            (package / name).unlink(missing_ok=True)


def system_files(tree: Tree, version: str) -> None:
    """What lies outside /opt."""
    tree.copy("config/vehicle.toml", "etc/fusiond/vehicle.toml")
    for unit in ("fusiond.service", "fusiond-gpsd.socket"):
        tree.copy(f"systemd/{unit}", f"lib/systemd/system/{unit}")
    tree.copy("systemd/sysusers-fusiond.conf", "usr/lib/sysusers.d/fusiond.conf")
    tree.copy("systemd/70-fusiond.rules", "lib/udev/rules.d/70-fusiond.rules")
    tree.copy("README.md", f"{HOME}/README.md")  # Documentation= of the unit
    doc = "usr/share/doc/fusiond"
    tree.copy("systemd/80-can0.network", f"{doc}/examples/80-can0.network")
    tree.copy("config/tactical.toml", f"{doc}/examples/tactical.toml")
    third_party = licences.FILE.name
    tree.write(f"{doc}/copyright", COPYRIGHT.format(third_party=third_party))
    tree.packed(f"{doc}/{third_party}", licences.FILE.read_text(encoding="utf-8"))
    entry = f"fusiond ({version}-1) unstable; urgency=medium\n\n  * See CHANGELOG.md.\n\n"
    epoch_s = int(os.environ.get("SOURCE_DATE_EPOCH", _last_commit_s()))
    when = formatdate(epoch_s, usegmt=True).replace("GMT", "+0000")
    tree.packed(f"{doc}/changelog.Debian", f"{entry} -- {MAINTAINER}  {when}\n")
    tree.packed(f"{doc}/changelog", (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8"))
    tree.packed("usr/share/man/man1/fusiond.1", man_pages.commands_page())
    tree.packed("usr/share/man/man5/fusiond.toml.5", man_pages.configuration_page())
    tree.link("usr/bin/fusiond", f"/{VENV}/bin/fusiond")
    tree.write("usr/share/lintian/overrides/fusiond", OVERRIDES)
    # By the program's own name, which is what the shell completes.
    start = "import sys; sys.argv = ['fusiond']; from fusiond.commands.app import main; main()"
    script = run(
        *(tree.root / VENV / "bin/python", "-P", "-c", start),
        env={**ENVIRONMENT, "_FUSIOND_COMPLETE": "source_bash"},
    )
    tree.write("usr/share/bash-completion/completions/fusiond", script.lstrip())


def _last_commit_s() -> int:
    git = ("git", "-C", REPOSITORY, "log", "-1", "--format=%ct")
    return int(run(*git).strip() or 0)


def control_files(tree: Tree, version: str, python: str) -> None:
    """DEBIAN/: what dpkg reads and runs."""
    ask = "import sys; print(*sys.version_info[:2])"
    major, minor = map(int, run(python, "-c", ask).split())
    size = sum(p.lstat().st_size for p in tree.root.rglob("*") if not p.is_dir())
    control = CONTROL.format(
        version=version,
        maintainer=MAINTAINER,
        architecture=run("dpkg", "--print-architecture").strip(),
        size_kib=-(-size // 1024),
        python=f"{major}.{minor}",
        next_python=f"{major}.{minor + 1}",
    )
    sums = run("find", ".", "-type", "f", "-exec", "md5sum", "{}", "+", cwd=tree.root)
    tree.write("DEBIAN/md5sums", sums.replace("  ./", "  "))
    tree.write("DEBIAN/control", control)
    tree.write("DEBIAN/conffiles", "".join(f"{path}\n" for path in CONFFILES))
    for name, text in (("postinst", POSTINST), ("prerm", PRERM), ("postrm", POSTRM)):
        tree.write(f"DEBIAN/{name}", text, 0o755)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=REPOSITORY / "build" / "deb")
    parser.add_argument("--python", default="/usr/bin/python3")
    parser.add_argument("--requirements", type=Path, default=REPOSITORY / "requirements.lock")
    options = parser.parse_args()
    work: Path = options.out.resolve()
    tree = Tree(work / "root")
    for name in ("root", "source", "wheels"):
        shutil.rmtree(work / name, ignore_errors=True)
    os.umask(0o022)
    version = man_pages.version("fusiond")
    environment(tree, options.python, options.requirements, work)
    system_files(tree, version)
    control_files(tree, version, options.python)
    package = work / f"fusiond_{version}-1.deb"
    run("dpkg-deb", "--root-owner-group", "-Zxz", "-z1", "--build", tree.root, package)
    print(package)


if __name__ == "__main__":
    main()
