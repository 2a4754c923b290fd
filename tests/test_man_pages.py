"""The manual pages and the Debian package's scripts, as `make man` and `make deb` make them."""

from __future__ import annotations

import subprocess

import pytest

from fusiond.configuration.schema import Config, Imu, Mqtt
from tools import debian_package, man_pages


@pytest.mark.parametrize("page", [man_pages.commands_page, man_pages.configuration_page])
def test_groff_reads_the_page_without_a_warning(page: object) -> None:
    assert callable(page)
    done = subprocess.run(
        ["groff", "-man", "-Tutf8", "-ww", "-z"],
        input=page(),
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_every_command_with_its_options() -> None:
    page = man_pages.commands_page().replace(r"\-", "-")
    for said in ("fusiond config init ", "fusiond log trim ", "fusiond status ", "--transmit"):
        assert said in page
    assert "--install-completion" not in page


def test_every_key_with_type_default_and_text() -> None:
    page = man_pages.configuration_page().replace(r"\-", "-")
    for model in (Config, Imu, Mqtt):
        for name in model.model_fields:
            assert name in page
    assert r"\fBrate_hz\fR (a number above 0; default 100.0)" in page
    assert "Angle random walk." in page
    assert "of a shipped one such as" in page  # of a driver's options, below CanOptions
    assert r".SH [sources.NAME] driver = \(dqcan_imu\(dq" in page


@pytest.mark.parametrize("name", ["POSTINST", "PRERM", "POSTRM"])
def test_scripts_of_the_package_are_sound_shell(name: str) -> None:
    text = getattr(debian_package, name)
    done = subprocess.run(["sh", "-n"], input=text, text=True, check=False, timeout=60)
    assert done.returncode == 0
    assert text.startswith("#!/bin/sh\nset -e\n")
