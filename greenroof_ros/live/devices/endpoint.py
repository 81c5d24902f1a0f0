"""Selection of a drive on Modbus or a relay on MQTT, and of its address."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_yaml
from greenroof_ros.base.mqtt import parse_topic
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.live.devices.drive import Drive, DriveEndpoint
from greenroof_ros.live.devices.drive_file import read_drive_file
from greenroof_ros.live.devices.modbus_line import parse_drive_address
from greenroof_ros.live.devices.relay import Relay, RelayEndpoint
from greenroof_ros.live.devices.relay_file import read_relay_file

# How a user chooses a drive: parameters of the pump node, and options of bringup.
CHOICE = (
    Parameter(
        "drive", "", meaning="make of the drive: a name in config/drives/, or a drive file",
    ),
    Parameter(
        "address", "", meaning="address of the drive: tcp://HOST:PORT for its own Ethernet port, "
        "gateway://HOST:PORT for a gateway to its serial port, or a serial line such as "
        "/dev/ttyUSB0. If the device id differs from that in the drive file, append it after a "
        "comma: gateway://HOST:PORT,17. For a relay: mqtt://HOST[:PORT]/DEVICE, where DEVICE is "
        "the relay's topic at the broker; mqtts:// for TLS",
    ),
    Parameter(
        "broker_login", "", meaning="YAML file with the username and password for a relay's broker",
    ),
    Parameter(
        "broker_authority", "", meaning="file of trusted certificates (PEM) for a relay's broker, "
        "if the system does not trust its certificate",
    ),
)

Endpoint: TypeAlias = DriveEndpoint | RelayEndpoint
Connection: TypeAlias = Drive | Relay


def read_endpoint(
    file: Path, at: str, key: str, login: str = "", authority: str = ""
) -> Endpoint:
    """Read a drive file or a relay file (recognized by its key ``protocol``), and add an address.

    Args:
        file: the drive file or relay file.
        at: address of the drive or relay. For a relay, this is ``mqtt://HOST[:PORT]/DEVICE``, or
            ``mqtts`` over TLS; for a drive, see
            :func:`greenroof_ros.live.devices.modbus_line.parse_drive_address`.
        key: name of the option or parameter that gives the address, for messages.
        login: file with ``username`` and ``password`` for a relay's broker; empty for none.
        authority: file of trusted certificates (PEM) for a relay's broker; empty to use those of
            the system.

    Raises:
        ConfigurationError: if the file or the address is invalid.
    """
    if "protocol" in read_yaml(file):
        return RelayEndpoint(read_relay_file(file), *parse_topic(at, key, login, authority))
    if login or authority:
        raise ConfigurationError(
            "has no broker to log in to: a login and certificates are only used for a relay on "
            "MQTT",
            key=key, value=at,
        )
    return DriveEndpoint(read_drive_file(file), parse_drive_address(at, key))
