"""A drive of either kind, a drive on Modbus or a relay on MQTT, and its address."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_yaml
from greenroof_ros.common.mqtt import parse_topic
from greenroof_ros.common.parameter import Parameter
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
        "address", "", meaning="address of the drive: tcp://HOST:PORT if it has its own Ethernet "
        "port, gateway://HOST:PORT for a gateway to its serial port, or a serial line such as "
        "/dev/ttyUSB0; append a comma and its device id if that differs from its file's, such as "
        "gateway://HOST:PORT,17; for a relay mqtt://HOST[:PORT]/DEVICE (its topic at a broker), "
        "mqtts:// for TLS",
    ),
    Parameter("broker_login", "", meaning="for a relay: YAML file with username and password"),
    Parameter(
        "broker_authority", "", meaning="for a relay: file of trusted certificates (PEM), if the "
        "system does not know the broker's",
    ),
)

Endpoint: TypeAlias = DriveEndpoint | RelayEndpoint
Connection: TypeAlias = Drive | Relay


def read_endpoint(
    file: Path, at: str, key: str, login: str = "", authority: str = ""
) -> Endpoint:
    """Read a drive file, or a relay file (which has the key ``protocol``), and add its address.

    Args:
        file: the drive file or relay file.
        at: its address. For a relay, this is ``mqtt://HOST[:PORT]/DEVICE``, or ``mqtts`` over TLS;
            otherwise see :func:`greenroof_ros.live.devices.modbus_line.parse_drive_address`.
        key: name of the address in error messages.
        login: for a relay's broker: file with ``username`` and ``password``; empty for none.
        authority: for a relay's broker: file of trusted certificates (PEM); empty for the system's.

    Raises:
        ConfigurationError: if the file or the address is wrong.
    """
    if "protocol" in read_yaml(file):
        return RelayEndpoint(read_relay_file(file), *parse_topic(at, key, login, authority))
    if login or authority:
        raise ConfigurationError(
            "has no broker to log in to: login and certificates are for a relay on MQTT",
            key=key, value=at,
        )
    return DriveEndpoint(read_drive_file(file), parse_drive_address(at, key))
