"""`vad pki` as its user meets it."""

from __future__ import annotations

import json
import os
import stat
from datetime import timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from vad.commands.app import app
from vad.commands.doctor import Visit, check_certificates
from vad.config import parse_settings
from vad.pki.certificates import utc_now
from vad.pki.folder import PkiFolder

SETTINGS = """
hub: cottage
state_dir: state
map: {file: floor.yaml}
robot: {type: neato, port: /dev/ttyACM0}
camera: {source: {type: v4l2, device: /dev/video0}}
radio: {}
devices: {}
"""


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with settings, in which the commands run."""
    monkeypatch.chdir(tmp_path)
    settings = tmp_path / "vad.yaml"
    settings.write_text(SETTINGS)
    monkeypatch.setenv("VAD_CONFIG", str(settings))
    return tmp_path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["pki", *arguments])


def fine(*arguments: str) -> str:
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def wrong(*arguments: str) -> str:
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert len(result.stderr.strip().splitlines()) == 1, "one line says what is wrong"
    return result.stderr


def test_from_nothing_to_a_tablet(hub: Path) -> None:
    assert "`vad pki init`" in wrong("list")
    assert "'cottage'" in fine("init")
    said = fine("issue", "viewer", "tablet")
    assert "VAD_CREDENTIALS=tablet vad devices --endpoint tls/" in said
    assert "tls/0.0.0.0:7448" in said, "what is missing in the settings"
    assert {path.name for path in (hub / "tablet").iterdir()} == {
        "ca.pem",
        "client.pem",
        "client.key",
        "zenoh.json5",
    }
    assert stat.S_IMODE((hub / "tablet" / "client.key").stat().st_mode) == 0o600
    assert PkiFolder(hub / "state" / "pki").register().hub == "cottage"


def test_the_endpoint_is_the_one_in_the_settings(hub: Path) -> None:
    settings = hub / "vad.yaml"
    settings.write_text(
        SETTINGS + "bus: {listen: ['tcp/127.0.0.1:7447', 'tls/192.168.1.9:9443'], pki: certificates}\n"
    )
    fine("init")
    said = fine("issue", "agent", "kitchen")
    assert "tls/192.168.1.9:9443" in said
    assert "does not listen" not in said
    assert "tls/192.168.1.9:9443" in (hub / "kitchen" / "zenoh.json5").read_text()
    assert (hub / "certificates" / "ca.key").is_file()


def test_the_list_tells_what_needs_care(hub: Path) -> None:
    fine("init")
    fine("issue", "viewer", "tablet")
    fine("issue", "agent", "kitchen", "--days", "20")
    result = run("list")
    assert result.exit_code == 1
    assert "ends soon: vad pki rotate kitchen" in result.stdout
    rows = json.loads(run("list", "--json").stdout)
    assert [(row["name"], row["role"], row["state"]) for row in rows] == [
        ("authority", "authority", "valid"),
        ("hub", "hub", "valid"),
        ("tablet", "viewer", "valid"),
        ("kitchen", "agent", "ends soon"),
    ]
    assert 19.5 < rows[3]["days_left"] <= 20
    fine("rotate", "kitchen", "--out", "new")
    assert run("list").exit_code == 0, "its successor is good"


def test_rotating_and_revoking(hub: Path) -> None:
    fine("init")
    fine("issue", "viewer", "tablet")
    said = fine("rotate", "tablet", "--out", "tablet-new")
    old = said.rpartition("vad pki revoke ")[2].strip()
    assert old.startswith("viewer.tablet.")
    assert f"{old} is revoked" in fine("revoke", old)
    assert "is revoked" in fine("rotate", "tablet", "--out", "third", "--revoke-old")
    fine("revoke", "tablet")
    assert "None is in force" in wrong("revoke", "tablet")
    states = [row["state"] for row in json.loads(run("list", "--json").stdout)[2:]]
    assert states == ["revoked"] * 3


def test_the_hubs_own_is_renewed_with_another_name(hub: Path) -> None:
    fine("init")
    pki = PkiFolder(hub / "state" / "pki")
    assert "localhost" in pki.hub_addresses()
    fine("rotate", "hub", "--address", "hub.example")
    assert {"hub.example", "localhost"} <= set(pki.hub_addresses())


def test_what_cannot_be_is_refused_before_anything_is_issued(hub: Path) -> None:
    fine("init")
    assert "there is an authority already" in wrong("init")
    (hub / "tablet").mkdir()
    (hub / "tablet" / "photo.jpg").touch()
    assert "Name another folder with --out" in wrong("issue", "viewer", "tablet")
    assert "not a name" in wrong("issue", "viewer", "../tablet")
    assert PkiFolder(hub / "state" / "pki").register().certificates == ()
    fine("issue", "viewer", "tablet", "--out", "t")
    assert "vad pki rotate tablet" in wrong("issue", "admin", "tablet", "--out", "t2")
    assert run("issue", "king", "tablet").exit_code == 2


def test_a_folder_of_its_own_needs_no_settings(hub: Path) -> None:
    (hub / "vad.yaml").unlink()
    assert "--config" in wrong("init")
    fine("init", "--dir", "pki", "--hub", "attic")
    fine("issue", "viewer", "tablet", "--dir", "pki")
    assert PkiFolder(hub / "pki").register().hub == "attic"


def test_help_teaches() -> None:
    said = fine("--help")
    for words in ("vad pki init", "vad pki issue viewer tablet", "tls/0.0.0.0:7448", "VAD_CREDENTIALS"):
        assert words in said
    for command in ("init", "issue", "revoke", "rotate", "list"):
        said = fine(command, "--help")
        assert "Example:" in said
        assert "Exit code 0" in said


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_folder_of_somebody_else(hub: Path) -> None:
    fine("init")
    (hub / "state" / "pki").chmod(0o000)
    try:
        assert "sudo" in wrong("list")
    finally:
        (hub / "state" / "pki").chmod(0o700)


def test_an_expired_hub_certificate_is_said(hub: Path) -> None:
    pki = PkiFolder(hub / "state" / "pki")
    pki.init("cottage", ["h"], utc_now() - timedelta(days=400))
    result = run("list")
    assert result.exit_code == 1
    assert "expired: vad pki rotate hub" in result.stdout
    fine("rotate", "hub")
    assert run("list").exit_code == 0


@pytest.mark.parametrize(
    ("age_days", "issue", "verdict", "words"),
    [
        (None, False, "bad", "vad pki init"),
        (0, False, "warning", "vad pki issue"),
        (0, True, "ok", "1 in force"),
        (400, True, "bad", "Is the clock right"),
    ],
)
async def test_the_doctor_looks_at_certificates(
    hub: Path, age_days: int | None, issue: bool, verdict: str, words: str
) -> None:
    listen = "bus: {listen: ['tcp/127.0.0.1:7447', 'tls/0.0.0.0:7448']}\n"
    pki = PkiFolder(hub / "state" / "pki")
    if age_days is not None:
        pki.init("cottage", ["h"], utc_now() - timedelta(days=age_days))
    if issue:
        pki.issue("viewer", "tablet", 1, utc_now())
    visit = Visit(parse_settings(SETTINGS + listen, where="vad.yaml"), hub / "vad.yaml", 0.1)
    (finding,) = await check_certificates(visit)
    assert finding.verdict == verdict
    assert words in finding.text + finding.remedy
    assert await check_certificates(Visit(parse_settings(SETTINGS, where=""), hub / "vad.yaml", 0.1)) == []
