"""Access to the broker: password and TLS, from the environment and from files only."""

from __future__ import annotations

import os
import re
import ssl
from collections.abc import Mapping
from pathlib import Path

import aiomqtt

from fusiond.configuration.load import ConfigError
from fusiond.configuration.schema import Mqtt

PASSWORD_VARIABLE = "FUSIOND_MQTT_PASSWORD"


def password(options: Mqtt, environ: Mapping[str, str] = os.environ) -> str | None:
    """Broker's password: from the environment, else the first line of the file, else none.

    Raises `ConfigError` if the file cannot be read.
    """
    if PASSWORD_VARIABLE in environ:
        return environ[PASSWORD_VARIABLE]
    if options.password_file is None:
        return None
    try:
        lines = options.password_file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise _unusable("password_file", options.password_file, error) from error
    if not lines or not lines[0]:
        raise ConfigError(
            f"mqtt.password_file = {str(options.password_file)!r}: empty: "
            "write the password in its first line"
        )
    return lines[0]


def readable_by_all(path: Path | None) -> bool:
    """True if every user of this computer can read the file."""
    return path is not None and path.exists() and bool(path.stat().st_mode & 0o004)


def tls_context(options: Mqtt) -> ssl.SSLContext | None:
    """TLS context that verifies the broker and its name; None if TLS is off.

    Raises `ConfigError` for unusable files, or for files with TLS off.
    """
    given = [k for k in ("ca_file", "cert_file", "key_file") if getattr(options, k) is not None]
    if not options.tls:
        if given:
            raise ConfigError(f"mqtt.{given[0]} is set but mqtt.tls is false: set mqtt.tls = true")
        return None
    if options.key_file is not None and options.cert_file is None:
        raise ConfigError("mqtt.key_file is set without mqtt.cert_file: give both, or neither")
    context = ssl.create_default_context()
    if options.ca_file is not None:
        try:
            context.load_verify_locations(options.ca_file)
        except OSError as error:
            raise _unusable("ca_file", options.ca_file, error) from error
    if options.cert_file is not None:
        try:
            # With an empty password OpenSSL does not ask for one on the terminal.
            context.load_cert_chain(options.cert_file, options.key_file, password="")
        except OSError as error:
            raise _unusable("cert_file", options.cert_file, error) from error
    return context


def advice(error: aiomqtt.MqttError, host: str, port: int) -> str:
    """Reason for the broker's refusal, and the remedy."""
    why = str(error) or "no answer"
    where = f"{host}:{port}"
    if isinstance(error, aiomqtt.MqttCodeError):
        return f"{why}: look at mqtt.username and the password ({PASSWORD_VARIABLE}, password_file)"
    if "CERTIFICATE_VERIFY_FAILED" in why:
        if "mismatch" in why:
            return f"{why}: mqtt.host must be a name that the broker's certificate has"
        if "expired" in why or "not yet valid" in why:
            return f"{why}: renew the broker's certificate, or set this computer's clock"
        return f"{why}: set mqtt.ca_file to the authority that signed the broker's certificate"
    why = re.sub(r"^\[Errno -?\d+\] ", "", why)
    remedy = "start one (systemctl status mosquitto), or correct its address"
    return f"no broker answers at {where} ({why}): {remedy}"


def _unusable(key: str, path: Path, error: Exception) -> ConfigError:
    return ConfigError(f"mqtt.{key} = {str(path)!r}: {error}: give a file that can be read")
