"""`vad web`, `vad web token`, and the settings of the page as `vad check-config` sees them."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from typer.testing import CliRunner
from waiting import free_port
from web_world import settings, status

from vad.bus import messages as m
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.commands.app import app
from vad.config import parse_settings
from vad.daemon.page import page_access
from vad.errors import ConfigError
from vad.web.access import TokenFile, write_token

PLAIN = """
robot: {type: neato, port: none}
camera: {source: {type: mjpeg, url: "http://127.0.0.1:9/"}}
radio: {}
devices: {}
map: {file: floor.yaml}
"""


async def asked(*parts: m.Part) -> tuple[int, str]:
    """Exit code and output of `vad web` where the daemon has these parts."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with Bus(BusSettings(listen=(endpoint,)), source="simulated") as bus:
        bus.publish_status(status("now", parts=parts))
        result = await asyncio.to_thread(CliRunner().invoke, app, ["web", "--endpoint", endpoint])
    return result.exit_code, result.output


async def test_it_tells_where_the_page_is() -> None:
    there = m.Part(part="web", state="ok", detail="http://127.0.0.1:9748/")
    assert await asked(there) == (0, "http://127.0.0.1:9748/\n")


async def test_it_tells_why_there_is_none() -> None:
    code, told = await asked()
    assert code == 1
    assert "web: {port: 9748}" in told
    code, told = await asked(m.Part(part="web", state="degraded", detail="port 9748 cannot be used"))
    assert code == 1
    assert "port 9748 cannot be used" in told


def test_a_token_is_written_and_told_once(tmp_path: Path) -> None:
    file = tmp_path / "web.token"
    result = CliRunner().invoke(app, ["web", "token", str(file)])
    assert result.exit_code == 0
    assert TokenFile(file).read().decode() in result.output
    assert "web.token_file" in result.output
    assert CliRunner().invoke(app, ["web", "token", str(tmp_path / "none" / "x")]).exit_code == 2


def test_without_a_port_there_is_no_page(tmp_path: Path) -> None:
    assert page_access(settings(tmp_path), tmp_path) is None


def test_the_token_is_looked_for_beside_the_settings(tmp_path: Path) -> None:
    write_token(tmp_path / "web.token")
    web = parse_settings(PLAIN + "web: {port: 9748, token_file: web.token}", where="vad.yaml")
    access = page_access(web, tmp_path)
    assert access is not None
    assert access.token is not None
    assert access.token.path == tmp_path / "web.token"
    (tmp_path / "web.token").chmod(0o644)
    with pytest.raises(ConfigError, match=r"web.token_file.*chmod 600"):
        page_access(web, tmp_path)


@pytest.mark.parametrize(
    "web", ["{port: 0}", "{port: 70000}", "{names: [UPPER]}", "{names: ['*']}", "{tokn: x}"]
)
def test_settings_that_cannot_be_are_refused_with_their_path(web: str) -> None:
    with pytest.raises(ConfigError, match=r"\$\.web"):
        parse_settings(PLAIN + f"web: {web}", where="vad.yaml")


def test_an_address_of_the_network_is_refused(tmp_path: Path) -> None:
    web = parse_settings(PLAIN + "web: {port: 9748, address: 0.0.0.0}", where="vad.yaml")
    with pytest.raises(ConfigError, match=r"\$\.web\.address.*reverse proxy"):
        page_access(web, tmp_path)
