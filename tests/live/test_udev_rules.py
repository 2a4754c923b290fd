"""The rules of udev: names of devices, and the service that starts when one is plugged in.

`udevadm test` applies them to a terminal of the kernel, in a mount namespace in which they are all
that is in /etc/udev/rules.d, and in which /dev and /run are empty: nothing of the host changes.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.places import REPOSITORY

RULES = sorted((REPOSITORY / "systemd").glob("7*.rules"))
TERMINAL = "/sys/class/tty/tty1"
INSIDE = """
mount --bind "$1" /etc/udev/rules.d
mount -t tmpfs none /run
mount -t tmpfs none /dev
exec udevadm test --action="$2" "$3" 2>&1
"""


def udevadm(rules: Path, action: str = "add") -> str:
    """Output of `udevadm test` with these rules."""
    command = ["unshare", "--map-root-user", "--mount", "sh", "-ec", INSIDE, "sh"]
    run = subprocess.run(
        [*command, str(rules), action, TERMINAL],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


def copied(folder: Path, *changes: tuple[str, str]) -> Path:
    """The shipped rules with what they match replaced."""
    for path in RULES:
        text = path.read_text()
        for old, new in changes if path.name.startswith("70") else ():
            assert old in text
            text = text.replace(old, new)
        (folder / path.name).write_text(text)
    return folder


def test_rules_are_read_without_a_complaint(tmp_path: Path) -> None:
    text = udevadm(copied(tmp_path))
    for path in RULES:
        assert f"Reading rules file: /etc/udev/rules.d/{path.name}" in text
    assert not re.findall(r"^/etc/udev/rules\.d/7\d-fusiond.*", text, re.MULTILINE)
    assert "SYSTEMD_WANTS" not in text  # a terminal of the kernel is no receiver


def test_complaint_would_be_seen(tmp_path: Path) -> None:
    rules = copied(tmp_path, ('SYMLINK+="gnss"', 'SIMLINK+="gnss"'))
    assert "70-fusiond.rules:5 Invalid key 'SIMLINK'" in udevadm(rules)


@pytest.mark.parametrize(
    ("match", "name"),
    [
        (
            'SUBSYSTEMS=="usb", ATTRS{idVendor}=="1546", ATTRS{idProduct}=="01a9"',
            "gnss",
        ),
        (
            'SUBSYSTEMS=="usb", ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6001", '
            'ATTRS{serial}=="AB0CDEFG"',
            "rdss",
        ),
    ],
)
def test_plugging_in_gives_the_name_and_starts_the_service(
    match: str, name: str, tmp_path: Path
) -> None:
    rules = copied(tmp_path, (match, 'KERNEL=="tty1"'))
    text = udevadm(rules)
    assert f"DEVLINKS=/dev/{name}\n" in text
    assert "SYSTEMD_WANTS=fusiond.service\n" in text
    assert "TAGS=:systemd:\n" in text
    assert "SYSTEMD_WANTS" not in udevadm(rules, "change")
