"""Every section of `[outputs]` has what serves it, and none is served unasked."""

from __future__ import annotations

from pathlib import Path

from fusiond.clock.stamp_mapping import Clock
from fusiond.configuration.load import load_config
from fusiond.configuration.outputs import Outputs
from fusiond.configuration.schema import ClockOptions, Config
from fusiond.outputs.base import Output
from fusiond.outputs.catalogue import MAKERS, make_outputs
from fusiond.outputs.client_sockets import Guests


def made(config: Config) -> dict[str, Output]:
    return make_outputs(
        config,
        on_event=lambda source, code, text: None,
        on_command=lambda command: "done",
        clock=Clock(ClockOptions()),
        guests=Guests(),
    )


def test_every_section_is_served_under_its_name(tmp_path: Path) -> None:
    assert MAKERS.keys() == Outputs.model_fields.keys() - {"geoid_separation_m"}
    path = tmp_path / "x.toml"
    others = [f"[outputs.{name}]\n" for name in MAKERS if name != "chrony"]
    path.write_text("".join(others) + '[outputs.chrony]\nsocket = "c.sock"\n')
    config = load_config(path)
    assert config.outputs.chrony is not None
    assert config.outputs.chrony.socket == tmp_path / "c.sock"
    outputs = made(config)
    assert next(iter(outputs)) == "mqtt"
    assert outputs.keys() == {"mqtt", *MAKERS}
    assert all(output.name == name for name, output in outputs.items())


def test_all_but_mqtt_is_off_by_default() -> None:
    assert list(made(Config())) == ["mqtt"]
