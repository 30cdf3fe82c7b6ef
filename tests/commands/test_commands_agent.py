"""`vad agent`: settings and options, what cannot be used, and an orderly end."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vad.agent.card import own_mac
from vad.commands.app import app
from vad.errors import ConfigError

MAC = "00:16:ea:00:00:01"
HUB = "tcp/127.0.0.1:7447"

runner = CliRunner()


def run(*arguments: str | Path) -> tuple[int, str]:
    result = runner.invoke(app, ["agent", *map(str, arguments)])
    return result.exit_code, " ".join(result.output.split())


def test_options_are_enough() -> None:
    code, said = run("--hub", HUB, "--id", "attic", "--mac", MAC, "--check")
    assert (code, said) == (0, f"the settings are usable (agent 'attic' of {HUB})")


def test_options_go_before_the_file(tmp_path: Path) -> None:
    file = tmp_path / "agent.yaml"
    file.write_text(f"hub: {HUB}\nid: cellar\ninterface: none0\nsource: {{type: follow, path: csi.fifo}}\n")
    code, said = run("--config", file, "--check")
    assert code == 2
    assert "interface: no such network interface: 'none0'" in said
    code, said = run("--config", file, "--id", "attic", "--mac", MAC, "--check")
    assert (code, "agent 'attic'" in said) == (0, True)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--mac", MAC), "the hub is not named. Give --hub tls/<its address>:7448"),
        (("--hub", "tcp/192.168.1.10:7447", "--mac", MAC), "plain TCP on this address"),
        (("--hub", "tls/192.168.1.10:7448", "--id", "attic", "--mac", MAC), "vad pki issue agent attic"),
        (("--hub", HUB, "--mac", "nobody"), "$.mac"),
        (("--hub", HUB, "--id", "a/b", "--mac", MAC), "$.id"),
        (("--hub", HUB, "--config", "none.yaml"), "none.yaml: cannot be read"),
    ],
)
def test_what_cannot_be_used_is_one_line(
    arguments: tuple[str, ...], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("VAD_CREDENTIALS", raising=False)
    code, said = run(*arguments)
    assert code == 2
    assert reason in said


@pytest.mark.parametrize(
    ("setting", "path"), [("batch_ms: 10", "$.batch_ms"), ("wireless: wlan0", "unknown field `wireless`")]
)
def test_unknown_and_wrong_settings_are_refused_with_their_path(
    tmp_path: Path, setting: str, path: str
) -> None:
    file = tmp_path / "agent.yaml"
    file.write_text(f"hub: {HUB}\nid: attic\n{setting}\n")
    code, said = run("--config", file, "--check")
    assert code == 2
    assert path in said


def test_the_example_is_usable_but_for_its_certificate(tmp_path: Path) -> None:
    example = Path(__file__).parents[2] / "config" / "agent.yaml"
    text = example.read_text().replace("/var/lib/vad-agent/credentials", str(tmp_path))
    file = tmp_path / "agent.yaml"
    file.write_text(text)
    code, said = run("--config", file, "--mac", MAC, "--check")
    assert code == 2
    assert f"{tmp_path}/ca.pem: no such file" in said


def test_the_only_wireless_card_is_the_agents(tmp_path: Path) -> None:
    for name, address in (("eth0", "aa:bb:cc:00:00:01"), ("wlan0", MAC.upper())):
        (tmp_path / name).mkdir()
        (tmp_path / name / "address").write_text(address + "\n")
    with pytest.raises(ConfigError, match="there is no wireless interface"):
        own_mac(None, tmp_path)
    (tmp_path / "wlan0" / "phy80211").mkdir()
    assert own_mac(None, tmp_path) == MAC
    assert own_mac("eth0", tmp_path) == "aa:bb:cc:00:00:01"
    (tmp_path / "eth0" / "phy80211").mkdir()
    with pytest.raises(ConfigError, match="there are 2 wireless interfaces"):
        own_mac(None, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_when_told_to_even_where_no_hub_is(tmp_path: Path, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "vad", "agent", "--hub", "tcp/127.0.0.1:9", "--id", "attic"]
    command += ["--mac", MAC, "--fifo", str(tmp_path / "none.fifo")]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    ) as process:
        assert process.stderr is not None
        said = process.stderr.readline() + process.stderr.readline()  # it runs, and says what is missing
        assert "cannot open" in said or "Cannot read" in said
        process.send_signal(number)
        _, rest = process.communicate(timeout=40)
    assert process.returncode == 0, rest
    assert "Traceback" not in rest
