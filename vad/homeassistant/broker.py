"""The connection to an MQTT broker: settings -> an open client, or the reason why there is none.

aiomqtt connects in a thread that cannot be stopped, so the way to the broker (name, port, TLS) is tried on
the event loop first: what is wrong is told in the system's words, and a thread is only given what answers.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import ssl
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from vad.config.mqtt import MqttSettings
from vad.errors import VadError

if TYPE_CHECKING:
    import aiomqtt

CONNECT_TIMEOUT_S = 5.0
ANSWER_TIMEOUT_S = 5.0
"""How long the broker may take to acknowledge anything."""
KEEPALIVE_S = 15
"""After one and a half times this without a sign of us the broker sends the last will."""
FAREWELL_S = 1.0
CLOSE_S = 0.2
OFFLINE = b"offline"
INSTALL = "pip install 'vad[homeassistant]'"


class BrokerError(VadError):
    """The broker cannot be used now."""

    code = "mqtt"


@asynccontextmanager
async def connected(
    settings: MqttSettings, base: Path, *, identifier: str, will_topic: str | None = None
) -> AsyncIterator[aiomqtt.Client]:
    """A connected client; BrokerError where that cannot be, or ends. Relative paths are taken from `base`.

    identifier: a second client of this name takes the first one's place. will_topic: where the broker says
    `offline` (retained) when this client is gone without a word.
    """
    mqtt = _aiomqtt()
    host, port = settings.endpoint
    where = f"{host}:{port}"
    context = None
    try:
        if settings.tls:
            context = await asyncio.to_thread(_tls_context, settings, base)
        password = await asyncio.to_thread(_password, settings, base)
        await _reach(host, port, context)
    except ssl.SSLCertVerificationError as error:
        raise BrokerError(
            f"its certificate does not count ({error.verify_message})",
            where=where,
            remedy="mqtt.host as in the certificate; mqtt.ca_file: whoever signed it",
        ) from error
    except ssl.SSLError as error:
        raise BrokerError(
            f"no TLS ({error.reason or error})", where=where, remedy="Is mqtt.port its TLS port?"
        ) from error
    except TimeoutError as error:
        raise BrokerError("does not answer", where=where, remedy=_REMEDY) from error
    except OSError as error:
        raise BrokerError(_words(error), where=where, remedy=_REMEDY) from error
    client = mqtt.Client(
        host,
        port,
        identifier=identifier,
        username=settings.username,
        password=password,
        tls_context=context,
        timeout=ANSWER_TIMEOUT_S,
        keepalive=KEEPALIVE_S,
        will=None if will_topic is None else mqtt.Will(will_topic, OFFLINE, qos=1, retain=True),
        logger=logging.getLogger("vad.homeassistant.aiomqtt"),
    )
    opening = asyncio.ensure_future(client.__aenter__())
    try:
        await asyncio.shield(opening)
    except asyncio.CancelledError:
        # the thread goes on for a moment: without it the socket would be nobody's
        await asyncio.wait({opening}, timeout=FAREWELL_S)
        await _abandon(client, mqtt)  # before it is cancelled: aiomqtt's callbacks cannot bear that
        opening.cancel()
        await asyncio.wait({opening})
        raise
    except mqtt.MqttError as error:
        await _abandon(client, mqtt)
        raise _refused(error, settings, where) from error
    try:
        yield client
    except mqtt.MqttError as error:
        raise BrokerError(f"the connection is lost ({error})", where=where) from error
    finally:
        if will_topic is not None:  # the last will comes only for who goes without a word
            with contextlib.suppress(mqtt.MqttError, TimeoutError):
                async with asyncio.timeout(FAREWELL_S):
                    await client.publish(will_topic, OFFLINE, qos=1, retain=True)
        await _abandon(client, mqtt)  # also where nobody acknowledged that


_REMEDY = "Does the broker run, and are mqtt.host and mqtt.port right?"


async def _abandon(client: aiomqtt.Client, mqtt: ModuleType) -> None:
    """Close a connection, or what one that did not come about has left open."""
    with contextlib.suppress(mqtt.MqttError, TimeoutError):
        async with asyncio.timeout(CLOSE_S):  # the socket closes at once; who listens is not told
            await client.__aexit__(None, None, None)


def check_settings(settings: MqttSettings, base: Path) -> None:
    """BrokerError where the client is missing, or a file that the settings name cannot be used."""
    if settings.host is None:
        return
    _aiomqtt()
    _password(settings, base)
    if settings.tls:
        _tls_context(settings, base)


def _refused(error: Exception, settings: MqttSettings, where: str) -> BrokerError:
    said = str(error)
    if any(word in said.lower() for word in ("authori", "username", "user name", "password")):
        who = "us without a name and a password" if settings.username is None else settings.username
        return BrokerError(
            f"the broker does not let in {who}",
            where=where,
            remedy="Set mqtt.username and mqtt.password_file to a user of the broker",
        )
    if "timed out" in said.lower():
        return BrokerError("something listens, but no MQTT broker", where=where, remedy=_REMEDY)
    return BrokerError(f"the broker refuses ({said})", where=where)


async def _reach(host: str, port: int, context: ssl.SSLContext | None) -> None:
    """OSError, ssl.SSLError or TimeoutError where the broker's port cannot be spoken to."""
    async with asyncio.timeout(CONNECT_TIMEOUT_S):
        _, writer = await asyncio.open_connection(host, port, ssl=context)
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


def _tls_context(settings: MqttSettings, base: Path) -> ssl.SSLContext:
    try:
        ca_file = None if settings.ca_file is None else str(base / settings.ca_file)
        context = ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as error:
        raise BrokerError(_words(error), where=f"mqtt.ca_file: {settings.ca_file}") from error
    if settings.certificate_file is not None:
        key_file = None if settings.key_file is None else base / settings.key_file
        try:
            context.load_cert_chain(base / settings.certificate_file, key_file)
        except (OSError, ssl.SSLError) as error:
            where = f"mqtt.certificate_file: {settings.certificate_file}"
            raise BrokerError(_words(error), where=where) from error
    return context


def _password(settings: MqttSettings, base: Path) -> str | None:
    if settings.password_file is None:
        return None
    where = f"mqtt.password_file: {settings.password_file}"
    try:
        text = (base / settings.password_file).read_text(encoding="utf-8")
    except OSError as error:
        raise BrokerError(_words(error), where=where, remedy="Readable by the daemon alone") from error
    except UnicodeDecodeError as error:
        raise BrokerError("not UTF-8 text", where=where) from error
    return text.partition("\n")[0].rstrip("\r")


def _words(error: OSError) -> str:
    if isinstance(error, ssl.SSLError):
        return error.reason or str(error)
    if error.errno is not None and error.errno > 0:
        return os.strerror(error.errno).lower()  # asyncio's own sentence repeats the address
    return error.strerror or str(error)


def _aiomqtt() -> ModuleType:
    try:
        import aiomqtt
    except ImportError as error:
        raise BrokerError("the MQTT client is not installed", where="mqtt", remedy=INSTALL) from error
    return aiomqtt
