"""What `vad setup` asks: camera, robot, radio, who joins, floor plan. Each answer goes into the draft."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec

from vad.camera.frame import Frame, FrameQueue
from vad.commands.asking import Asker
from vad.commands.console import complain
from vad.config import CameraSettings, RobotSettings, brings_map
from vad.errors import ConfigError
from vad.robot.map_server import load_floor_plan
from vad.setup.draft import (
    NO_CAMERA,
    NO_PORT,
    Draft,
    camera_choice,
    channel_hz,
    csi_card_missing,
    kinect_choice,
    radio_choice,
    robot_url,
    router_endpoint,
)
from vad.setup.lan import hear_router, hear_valetudo
from vad.setup.neato import NeatoVersion, ask_version
from vad.setup.surroundings import Surroundings
from vad.setup.tables import camera_words

TRY_ROBOT_S = 6.0
PICTURE_S = 8.0
CHANNEL = 48

Choice = dict[str, Any]


def ask_camera(ask: Asker, found: Surroundings, draft: Draft, folder: Path) -> None:
    """Which camera; on wish a picture of what it sees."""
    before = draft.chosen.get("camera", {}).get("source")
    usable = [camera for camera in found.cameras if camera.formats]
    choices: list[tuple[str, Choice]] = [
        (f"{camera.name} ({camera.device}), {camera_words(camera)}", camera_choice(camera))
        for camera in usable
    ]
    choices += [
        (f"Kinect v2 {kinect.serial}".rstrip(), kinect_choice(kinect, len(found.kinects) > 1))
        for kinect in found.kinects
        if not kinect.slow
    ]
    if before is not None and before not in [choice for _, choice in choices]:
        choices.insert(0, (f"as before: {_flat(before)}", before))
    names = [name for name, _ in choices]
    names += ["an IP camera (rtsp://) or a stream (http://), by its address", "none yet"]
    at = ask.choose("Which camera sees the robot drive?", names, 0 if choices else len(names) - 1)
    if at < len(choices):
        source = choices[at][1]
    elif at == len(choices):
        url = ask.text("Its address", "", _camera_url)
        source = {"type": "rtsp" if url.startswith("rtsp") else "mjpeg", "url": url}
    else:
        source = {"type": "v4l2", "device": NO_CAMERA}
        draft.missing.append(f"there is no camera yet: plug one in; {NO_CAMERA} is tried")
    draft.chosen["camera"] = {**draft.chosen.get("camera", {}), "source": source}
    if at < len(names) - 1 and ask.confirm("Save a picture of what it sees?", default=False):
        _save_picture(ask, source, folder / "camera.jpg")


def _camera_url(url: str) -> None:
    if not url.startswith(("rtsp://", "http://")):
        raise ConfigError(
            "this is no camera's address", where=url, remedy="rtsp://host/path or http://host/path"
        )


def _save_picture(ask: Asker, source: Choice, path: Path) -> None:
    import cv2  # takes a while to import, as do the cameras

    from vad.daemon.adapters import camera_source

    async def first() -> Frame | str:
        frames = FrameQueue(1)
        camera = camera_source(msgspec.convert({"source": source}, CameraSettings), path.parent)
        task = asyncio.create_task(camera.run(frames))
        try:
            async with asyncio.timeout(PICTURE_S):
                return await frames.get()
        except TimeoutError:
            return camera.health.detail or f"no picture in {PICTURE_S:g} s"
        finally:
            task.cancel()
            await asyncio.wait({task})

    frame = asyncio.run(first())
    if isinstance(frame, str):
        complain(f"no picture: {frame}")
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".jpg", frame.image)[1].tobytes())
    except OSError as error:
        complain(f"{path}: {error.strerror}")
        return
    height, width = frame.image.shape[:2]
    ask.say(f"{width}x{height} picture in {path}")


def ask_robot(ask: Asker, found: Surroundings, draft: Draft) -> None:
    """Which robot; a Neato is asked for its name where the user agrees."""
    before = draft.chosen.get("robot")
    named = [port for port in found.ports if port.says_neato]
    neatos = {port.path: "calls itself a Neato" for port in named}
    others = [port for port in found.ports if port not in named]
    question = f"Ask {len(others)} serial port(s) for a Neato? It is only asked for its version"
    if others and not ask.silent and ask.confirm(question, default=not named):
        for port in others:
            answer = ask_version(str(port.open_path))
            told = answer if isinstance(answer, str) else _neato_words(answer)
            ask.say(f"  {port.path}: {told}")
            if isinstance(answer, NeatoVersion):
                neatos[port.path] = told
    choices: list[tuple[str, Choice]] = [
        (f"{told} ({path})", {"type": "neato", "port": path, "lidar": True}) for path, told in neatos.items()
    ]
    choices += [
        (f"Valetudo at {address}", {"type": "valetudo", "url": f"http://{address}"})
        for address in found.valetudo
    ]
    choices += [
        (f"ROS 2 by {endpoint}", {"type": "ros2", "endpoint": endpoint}) for endpoint in found.routers
    ]
    if before is not None and before not in [choice for _, choice in choices]:
        choices.insert(0, (f"as before: {_flat(before)}", before))
    by_hand = [
        "a Neato by its port",
        "a robot with Valetudo by its address",
        "a ROS 2 robot (TurtleBot 4 ...) by the address of its zenoh router",
        "a Roomba or Create 2 by its port",
    ]
    names = [*(name for name, _ in choices), *by_hand, "none yet"]
    at = ask.choose("Which robot?", names, 0 if choices else len(names) - 1)
    if at < len(choices):
        draft.chosen["robot"] = choices[at][1]
    elif at == len(names) - 1:
        draft.chosen["robot"] = {"type": "neato", "port": NO_PORT, "lidar": True}
        draft.missing.append(
            "there is no robot yet: without one nothing knows where the camera is. Run it again"
        )
    else:
        draft.chosen["robot"] = _by_hand(ask, found, at - len(choices))


def _neato_words(version: NeatoVersion) -> str:
    return " ".join(word for word in ("Neato", version.model, version.software) if word)


def _by_hand(ask: Asker, found: Surroundings, which: int) -> Choice:
    if which in (0, 3):
        default = found.ports[0].path if found.ports else ""
        port = ask.text("Its port (device, socket://host:port, rfc2217://host:port)", default)
        return (
            {"type": "neato", "port": port, "lidar": True} if which == 0 else {"type": "roomba", "port": port}
        )
    while True:
        if which == 1:
            where = robot_url(ask.text("Its address, e.g. 192.168.1.30", ""))
            good, told = asyncio.run(hear_valetudo(where, TRY_ROBOT_S))
        else:
            where = router_endpoint(ask.text("The router, e.g. 192.168.1.20", "", router_endpoint))
            good, told = asyncio.run(hear_router(where, TRY_ROBOT_S))
        ask.say(f"  {where}: {told}")
        if good or ask.confirm("Use it all the same?", default=False):
            return {"type": "valetudo", "url": where} if which == 1 else {"type": "ros2", "endpoint": where}


def ask_network(ask: Asker, found: Surroundings, draft: Draft) -> None:
    """Who tells which devices join, and the channel; CSI needs its centre."""
    draft.missing += csi_card_missing(found)
    devices, radio = draft.chosen.setdefault("devices", {}), draft.chosen.setdefault("radio", {})
    points = [point for point in found.access_points if not point.trouble]
    if points:
        names = [f"{point.ssid or point.socket} ({point.socket})" for point in points]
        at = ask.choose("Whose stations are put on the map?", [*names, "all of them"], 0)
        taken = points if at == len(points) else [points[at]]
        devices["hostapd"] = [point.socket for point in taken]
        radio |= radio_choice(taken[0])
    elif serving := [one.name for one in found.wireless if one.access_point]:
        devices["nl80211"] = serving
    for point in found.access_points:
        if point.trouble:
            draft.missing.append(f"{point.socket} cannot be asked ({point.trouble}): run it with sudo")
    if found.leases:
        devices["leases"] = list(found.leases)
    if not any(devices.get(key) for key in ("hostapd", "nl80211", "leases", "static")):
        devices["hostapd"] = ["/run/hostapd/wlan0"]
        draft.missing.append("no access point runs here: hostapd's socket /run/hostapd/wlan0 is waited for")
    if not (points and points[0].frequency_mhz) and "carrier_hz" not in radio:
        channel = ask.text(f"Wi-Fi channel (left at {CHANNEL} if unknown)", str(CHANNEL), _channel)
        radio["carrier_hz"] = _channel(channel)


def _channel(typed: str) -> float:
    if not typed.isdecimal():
        raise ConfigError(f"{typed!r} is no channel", remedy="1 to 13, or 36 to 177")
    return channel_hz(int(typed))


def ask_plan(ask: Asker, found: Surroundings, draft: Draft, folder: Path) -> None:
    """The floor plan's file, where the robot brings none; leave `map` alone where it does."""
    plan = draft.chosen.setdefault("map", {})
    robot: RobotSettings = msgspec.convert(draft.chosen["robot"], RobotSettings)
    if brings_map(robot) or plan.get("file"):
        return
    names = [f"{one.path}: {one.size_m[0]:.1f} m x {one.size_m[1]:.1f} m" for one in found.plans]
    at = ask.choose("This robot brings no floor plan. Which file?", [*names, "another file", "none yet"], 0)
    if at < len(names):
        plan["file"] = found.plans[at].path
    elif at == len(names):
        plan["file"] = ask.text("A map_server YAML", "", lambda name: load_floor_plan(folder / name, epoch=1))
    if not plan.get("file"):
        plan["file"] = "floor.yaml"
        draft.missing.append(
            f"there is no floor plan yet: draw one or `vad map import` it as {folder}/floor.yaml"
        )


def _flat(choice: Choice) -> str:
    return ", ".join(str(value) for value in choice.values())
