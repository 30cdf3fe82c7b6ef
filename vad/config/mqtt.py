"""Settings: Home Assistant over MQTT."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

Topic = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*$", max_length=128)]


class MqttSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Home Assistant by way of an MQTT broker; wants `pip install 'vad[homeassistant]'`.

    host: of the broker; left out: none
    port: left out: 1883, with tls 8883
    username: where the broker wants one
    password_file: its first line is the password; readable by the daemon alone
    tls: encrypt, and check the broker's certificate
    ca_file: whom to believe about that, PEM; left out: the system's list
    certificate_file: this hub's own certificate, PEM, where the broker wants one
    key_file: its private key, PEM; left out: in certificate_file
    discovery_prefix: as in Home Assistant's MQTT settings
    base_topic: where the daemon's own topics begin: vad/home/...
    """

    host: Annotated[str, Meta(min_length=1, examples=["192.168.1.5"])] | None = None
    port: Annotated[int, Meta(ge=1, le=65535, examples=[1883])] | None = None
    username: Annotated[str, Meta(examples=["vad"])] | None = None
    password_file: Annotated[str, Meta(examples=["/etc/vad/mqtt.password"])] | None = None
    tls: bool = False
    ca_file: Annotated[str, Meta(examples=["/etc/vad/broker-ca.pem"])] | None = None
    certificate_file: Annotated[str, Meta(examples=["/etc/vad/mqtt.pem"])] | None = None
    key_file: Annotated[str, Meta(examples=["/etc/vad/mqtt.key"])] | None = None
    discovery_prefix: Topic = "homeassistant"
    base_topic: Topic = "vad"

    @property
    def endpoint(self) -> tuple[str, int]:
        """Host and port of the broker; ValueError where none is given."""
        if self.host is None:
            raise ValueError("no broker is given")
        return self.host, self.port or (8883 if self.tls else 1883)
