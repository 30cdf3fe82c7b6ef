"""config/: written from the types and up to date, every example usable, every commented setting true."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest
import yaml
from typer.testing import CliRunner

from vad.commands.app import app
from vad.config import AgentSettings, Settings, agent_settings, load_settings, parse_settings
from vad.config.documents import agent_reference, hub_reference
from vad.config.meaning import meaning, unit
from vad.config.reference import EXAMPLE, settings_file, settings_schema
from vad.errors import ConfigError

CONFIG = Path(__file__).parents[1] / "config"
_COMMENTED = re.compile(r"( *)#([a-z0-9_]+:.*)")
_ALTERNATIVE = re.compile(r" *# -- or: ")


@pytest.mark.parametrize(
    ("name", "text", "command"),
    [
        ("vad.yaml", hub_reference(), "vad config reference"),
        ("agent.yaml", agent_reference(), "vad config reference --agent"),
    ],
)
def test_the_files_are_what_the_types_say(name: str, text: str, command: str) -> None:
    assert (CONFIG / name).read_text(encoding="utf-8") == text, f"write it anew: {command} > config/{name}"
    answer = CliRunner().invoke(app, command.split()[1:])
    assert answer.exit_code == 0
    assert answer.stdout_bytes.decode() == text


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.name)
def test_every_example_can_be_used(path: Path) -> None:
    if path.name == "agent.yaml":
        agent_settings(yaml.safe_load(path.read_text(encoding="utf-8")), where=path.name)
        return
    load_settings(path)
    if path.name != "vad.yaml":
        text = path.read_text(encoding="utf-8")
        assert "FILL IN" in text
        assert len(text.splitlines()) < 40


def test_an_example_tells_apart_what_must_be_filled_in() -> None:
    """What is different in every home is marked in each example."""
    for path in CONFIG.glob("*.yaml"):
        if path.name in {"vad.yaml", "agent.yaml"}:
            continue
        for line in path.read_text(encoding="utf-8").splitlines():
            if re.match(r" *(port|url|endpoint|device|carrier_hz|hostapd|file): ", line):
                assert "FILL IN" in line, f"{path.name}: {line}"


def _settings_of(lines: list[str], agent: bool) -> Settings | AgentSettings:
    text = "\n".join(lines)
    if agent:
        return agent_settings(yaml.safe_load(text), where="agent.yaml")
    return parse_settings(text, where="vad.yaml")


@pytest.mark.parametrize("agent", [False, True], ids=["vad.yaml", "agent.yaml"])
def test_each_commented_default_is_the_default(agent: bool) -> None:
    """Without its # a setting changes nothing, unless what stands there is said to be an example."""
    lines = (agent_reference() if agent else hub_reference()).splitlines()
    plain = _settings_of(lines, agent)
    tried, in_alternative, depth = 0, False, 0
    refused: list[str] = []
    for index, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        if _ALTERNATIVE.match(line):
            in_alternative, depth = True, indent
        elif in_alternative and (not line.strip() or indent < depth):
            in_alternative = False
        found = _COMMENTED.fullmatch(line)
        if in_alternative or found is None or line.rstrip().endswith("without joining"):
            continue
        said = line
        for more in lines[index + 1 :]:  # its comment goes on
            if not re.fullmatch(r" +# .*", more) or len(more) - len(more.lstrip()) < 20:
                break
            said += " " + more.strip().removeprefix("# ")
        changed = [*lines]
        changed[index] = found[1] + found[2]
        try:
            result = _settings_of(changed, agent)
        except ConfigError as error:
            refused.append(error.what)
            continue
        assert (result == plain) == (EXAMPLE not in said), line
        tried += 1
    assert tried >= (8 if agent else 25)
    assert refused == []


@pytest.mark.parametrize(
    ("section", "count"),
    [("robot", 6), ("camera", 5), ("radio", 2)],
)
def test_each_alternative_can_take_the_place_of_the_first(section: str, count: int) -> None:
    lines = hub_reference().splitlines()
    start = lines.index(f"{section}:")
    end = next(i for i in range(start + 1, len(lines)) if not lines[i])
    block = lines[start:end]
    heads = [i for i, line in enumerate(block) if _ALTERNATIVE.match(line)]
    assert len(heads) == count - 1
    depth = len(block[heads[0]]) - len(block[heads[0]].lstrip())
    first = next(i for i, line in enumerate(block) if re.match(rf" {{{depth}}}type: ", line))
    for number, head in enumerate(heads):
        after = heads[number + 1] if number + 1 < len(heads) else len(block)
        taken = []
        for line in block[head + 1 : after]:
            if len(line) - len(line.lstrip()) < depth:
                break
            found = _COMMENTED.fullmatch(line)
            taken.append(found[1] + found[2] if found else line)
        changed = [*block[:first], *taken, *(line for line in block[after:] if "type:" not in line)]
        text = "\n".join([*lines[:start], *changed, *lines[end:]])
        values = yaml.safe_load(text)
        values["radio"] = values["radio"] or {}
        part = values[section] if section == "robot" else values[section]["source"]
        if part["type"] in {"roomba", "serial-json", "zenoh-json"}:
            values["map"] = {"file": "floor.yaml"}
        if part["type"] == "valetudo":
            del part["key"]
        if part["type"] == "ros2":
            part["pose"] = "pose_covariance"
        settings = parse_settings(yaml.safe_dump(values), where="vad.yaml")
        chosen = settings.robot if section == "robot" else getattr(settings, section).source
        assert chosen.__struct_config__.tag == part["type"]
        named = {field.name for field in msgspec.structs.fields(chosen)}
        assert named <= set(part) | {"key"}, f"{part['type']} lacks a setting"


def test_a_chosen_value_stands_there_and_survives() -> None:
    chosen = {
        "hub": "flat-3",
        "robot": {"type": "roomba", "port": "socket://192.168.1.41:3333", "baud": 57600},
        "camera": {"source": {"type": "kinect2", "fraction": 4}, "focal_px": 501.5},
        "radio": {"carrier_hz": 5.18e9, "antenna_offset_m": [0.1, -0.25, 0.0]},
        "devices": {"static": [{"mac": "11:22:33:44:55:06", "name": "Lampe: Küche #1"}], "agents": False},
        "map": {"file": "floor.yaml"},
        "capture": {"mapped_radius_m": 0.55},
    }
    text = settings_file(Settings, chosen, alternatives=False)
    settings = parse_settings(text, where="vad.yaml")
    assert settings == parse_settings(yaml.safe_dump(chosen), where="plain")
    assert "valetudo" not in text
    assert max(map(len, text.splitlines())) <= 110


def test_an_empty_section_is_its_defaults_and_an_empty_choice_is_refused() -> None:
    base = "robot: {type: neato, port: a, lidar: true}\ncamera: {source: {type: v4l2, device: b}}\n"
    full = parse_settings(base + "radio: {}\ndevices: {}\n", where="a")
    assert parse_settings(base + "radio:\ndevices:\nmap:\ncapture:\n", where="b") == full
    with pytest.raises(ConfigError, match=r"camera"):
        parse_settings(
            base.replace("{source: {type: v4l2, device: b}}", "") + "radio:\ndevices:\n", where="c"
        )


def test_a_field_without_its_meaning_is_refused() -> None:
    class Lamp(msgspec.Struct):
        """A lamp.

        power_w: what it takes
            at night
        """

        power_w: float
        colour: str

    with pytest.raises(ValueError, match="colour"):
        meaning(Lamp)

    class Named(msgspec.Struct):
        """A lamp.

        power_w: what it takes
            at night
        shade: gone
        """

        power_w: float

    with pytest.raises(ValueError, match="shade"):
        meaning(Named)


def test_the_longest_end_of_a_name_is_its_unit() -> None:
    assert unit("traffic_packets_per_s") == "per second"
    assert unit("max_s") == "seconds"
    assert unit("bandwidth_mhz") == "MHz"
    assert unit("together") == ""


@pytest.mark.parametrize("agent", [False, True])
def test_the_schema_says_what_each_setting_means(agent: bool) -> None:
    schema = settings_schema(AgentSettings if agent else Settings)
    for name, part in schema["$defs"].items():
        for key, value in part["properties"].items():
            assert key == "type" or value.get("description"), f"{name}.{key}"
    if not agent:
        fraction = schema["$defs"]["Kinect2CameraSettings"]["properties"]["fraction"]
        assert fraction["enum"] == [1, 2, 4]
        assert "1920x1080" in fraction["description"]
        assert {"type": "null"} in schema["$defs"]["Settings"]["properties"]["capture"]["anyOf"]
