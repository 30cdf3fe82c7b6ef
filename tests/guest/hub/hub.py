"""In the guest: vad installed from its package, run by systemd, on a home that the kernel believes in.

`hub.py short`: install, start, ask, stop, purge. `hub.py whole`: also the way of a new device onto the map,
and every fault that a year brings. What was seen goes to report.json, row by row; a row that never came
says so.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from guest import HERE, Home, Hub, Network, Service, StuckError, say, sh, until

from vad.bus.messages import DeviceWish

TOLD = HERE / "story.json"
STORY: dict[str, Any] = json.loads(TOLD.read_text()) if TOLD.exists() else {}
MAC = str(STORY.get("mac", ""))
STATE = Path("/var/lib/vad")
CONFIG = Path("/etc/vad/vad.yaml")
DROP_IN = Path("/etc/systemd/system/vad.service.d/slow.conf")
PARTS = ("camera", "robot", "hostapd", "csi.connector", "store")
CAMERA = "/dev/v4l/by-id/usb-vad_emulated_camera_0001-video-index0"
ROBOT = "/dev/serial/by-id/usb-Neato_Robotics_Botvac_emulated_0001-if00"
BARE = f"""hub: guest
source: simulated
map: {{file: floor.yaml, epoch: 1}}
robot: {{type: neato, port: {ROBOT}}}
camera:
  source: {{type: v4l2, device: {CAMERA}, fps: {STORY.get("fps", 15)}}}
devices: {{hostapd: [/run/hostapd/wlan0]}}
"""
PLAYED = f"""radio:
  source: {{type: connector, allow_user_space: true}}
  carrier_hz: {STORY.get("carrier_hz")}
  antenna_offset_m: {STORY.get("antenna_offset_m")}
capture: {{mapped_radius_m: 0.9, min_walks: 1, max_s: 20, keep_free_mb: 8, quota_mb: 40}}
vision: {{model: network.onnx, max_fps: {STORY.get("fps")}}}
"""
SLOW = """[Service]
TimeoutStartSec=300
TimeoutStopSec=60
"""
"""For an emulated processor on a busy machine; everything else of the unit is the package's."""
LOOK = """
import json, sys, cv2
from vad.vision.people import PoseNetwork
people = PoseNetwork().infer(cv2.imread(sys.argv[1]))
print(json.dumps([person.keypoints[:, :2].tolist() for person in people]))
"""
DISK_MB = 96
RENAMES = 400
FRAMES = 20
"""So many pictures seen show that it goes on."""

SOON_S, PATIENCE_S = 180.0, 400.0
"""Waits for what is quick, and for what is long, on an emulated processor of a busy machine."""

service, hub = Service(), Hub()
report: dict[str, Any] = {}


@contextlib.contextmanager
def row(name: str, *, needed: bool = False) -> Iterator[dict[str, Any]]:
    """One row of the report: what it found, how long it took, what the daemon logged, why it is stuck.

    needed: without it nothing else makes sense.
    """
    begun_s = time.monotonic()
    found: dict[str, Any] = {}
    report[name] = found
    say(f"{name} ...")
    try:
        yield found
    except StuckError as error:
        found["stuck"] = str(error)
        with contextlib.suppress(StuckError):
            found["journal"] = service.journal(begun_s)[-40:]
            status = hub.status()
            found["parts"] = (
                {} if status is None else {p.part: f"{p.state}: {p.detail}" for p in status.parts}
            )
    found["took_s"] = round(time.monotonic() - begun_s, 1)
    say(f"{name}: {json.dumps({k: v for k, v in found.items() if k != 'journal'})[:1500]}")
    (HERE / "report.json").write_text(json.dumps(report, indent=1))
    if needed and "stuck" in found:
        sys.exit(f"{name}: {found['stuck']}")


def install() -> None:
    """The package, the way a person would."""
    with row("installed", needed=True) as found:
        package = next(HERE.glob("vad_*.deb"))
        sh("apt-get", "install", "-y", "-qq", "--no-install-recommends", f"{package}")
        found["package"] = sh("dpkg-query", "-W", "-f", "${Package} ${Status}", "vad")
        found["version"] = sh("vad", "--version")
        found["before settings"] = service.show("ActiveState", "ConditionResult", "UnitFileState")
        for file in (*HERE.glob("floor.*"), *HERE.glob("*.onnx")):
            shutil.copy(file, CONFIG.parent)
        CONFIG.write_text(BARE + (PLAYED if STORY else "radio: {}\n"))
        found["check-config"] = sh("vad", "check-config")
        DROP_IN.parent.mkdir(parents=True)
        DROP_IN.write_text(SLOW)
        sh("systemctl", "daemon-reload")


def start() -> None:
    """The unit."""
    with row("started", needed=True) as found:
        sh("systemctl", "enable", "--now", "vad")
        found |= service.show("ActiveState", "SubState", "Type", "User", "WatchdogUSec", "StatusText")
        found["ready_s"] = service.started_in_s()
        found["answers_s"] = until(hub.status, "an answer over zenoh", SOON_S)
        # Until it has loaded what it knows, it speaks of the robot and the store alone.
        until(lambda: hub.is_in("camera", "ok", "degraded", "failed"), "a word of the camera", SOON_S)
        status = hub.status()
        found["parts"] = {p.part: f"{p.state}: {p.detail}" for p in status.parts} if status else {}
        found["as user"] = Path(f"/proc/{service.pid}/status").read_text().split("Uid:")[1].split()[0]


def look() -> None:
    """The package's own network, in its own environment, at one picture."""
    with row("pose network") as found:
        picture = HERE / "frames" / f"{STORY['looked_at']:04}.jpg"
        begun_s = time.monotonic()
        said = sh("/usr/lib/vad/bin/python", "-I", "-c", LOOK, str(picture))
        found["looked_s"] = round(time.monotonic() - begun_s, 1)
        found["found"] = json.loads(said)
        (found["on the host"],) = STORY["people"]


def stop() -> None:
    """The end of the service, and of the package."""
    with row("stopped") as found:
        found["status command"] = sh("vad", "status", "--json", check=False)[:200]
        begun_s = time.monotonic()
        sh("systemctl", "stop", "vad")
        found["stop_s"] = round(time.monotonic() - begun_s, 1)
        found |= service.show("ActiveState", "Result", "ExecMainStatus")
        found["tracebacks"] = [line for line in service.journal() if "Traceback" in line]
    with row("purged") as found:
        sh("umount", str(STATE), check=False)  # where it was a small file system
        (STATE / "mark").write_text("to be purged")
        sh("apt-get", "purge", "-y", "-qq", "vad")
        kept = (*(p for p in ("/etc/vad", "/usr/lib/vad", "/usr/bin/vad") if Path(p).exists()),)
        inside = [p.name for p in STATE.iterdir()] if STATE.exists() else []
        found["left"] = [*kept, *inside]
        found["unit"] = service.show("LoadState")["LoadState"]


def small_disk() -> None:
    """The daemon's own folder is a small file system."""
    STATE.mkdir(exist_ok=True)
    sh("mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m,mode=0755", "tmpfs", str(STATE))


def calibrate(home: Home) -> None:
    """The robot drives to and fro until the camera knows where it is."""
    with row("camera calibrated", needed=True) as found:
        until(lambda: hub.is_in("camera", "ok"), "pictures", SOON_S)
        until(lambda: hub.is_in("robot", "ok", "degraded"), "the robot", SOON_S)
        drives = 0
        while True:
            left_s = home.play("drive", "rest" if drives % 2 == 0 else "start", backwards=drives % 2 == 1)
            drives += 1
            time.sleep(left_s)
            with contextlib.suppress(StuckError):
                until(lambda: (c := hub.camera()) and c.state == "valid", "a calibration", 15.0)
                if drives % 2 == 1:
                    break
            say(f"after {drives} drives: {(c := hub.camera()) and (c.state, c.reason, c.pairs)}")
            if drives > 5:
                raise StuckError(f"no calibration after {drives} drives: {hub.camera()}")
        camera = hub.camera()
        assert camera is not None
        assert camera.position_m is not None
        found["drives"] = drives
        found["pairs"] = camera.pairs
        found["off_m"] = round(
            sum((a - b) ** 2 for a, b in zip(camera.position_m, STORY["camera_m"], strict=True)) ** 0.5, 3
        )


def measure(home: Home, network: Network) -> None:
    """The station joins; somebody walks until it is on the map."""
    with row("joined", needed=True) as found:
        network.join()
        found["seen_s"] = until(lambda: hub.device(MAC), "the station in the device table", SOON_S)
        device = hub.device(MAC)
        assert device is not None
        found |= {"state": device.state, "reason": device.reason, "in_network": device.in_network}
    with row("mapped") as found:
        walks = [name for name in home.segments if name.startswith("walk")]
        for number, name in enumerate(walks * 2, 1):
            time.sleep(home.play(name, "rest"))
            with contextlib.suppress(StuckError):
                until(solved(number), "the walk's result", 90.0)
            device = hub.device(MAC)
            say(f"after {name}: {device and (device.state, device.reason, device.radius90_m)}")
            if device is not None and device.state == "mapped":
                break
        else:
            raise StuckError(f"not mapped after {number} walks: {device}")
        found["walked"] = number
        place = Path("/tmp/truth.json")
        place.write_text(json.dumps({MAC: {"x_m": STORY["truth"]["x"], "y_m": STORY["truth"]["y"]}}))
        found["devices"] = json.loads(sh("vad", "devices", "--json", "--truth", str(place)))
        say(sh("vad", "devices", "--truth", str(place)))


def solved(walks: int) -> Callable[[], bool]:
    """Whether so many walks have come to an end, whatever they told."""

    def over() -> bool:
        device = hub.device(MAC)
        if device is not None and device.state == "mapped":
            return True
        captures = hub.captures()
        return len(captures) >= walks and all(c.state in ("done", "aborted") for c in captures)

    return over


def known() -> dict[str, Any]:
    """What must survive everything: the device's place, the camera's."""
    device, camera = hub.device(MAC), hub.camera()
    return {
        "state": device and device.state,
        "place": device and (device.x_m, device.y_m, device.radius90_m, device.walks),
        "camera": camera and camera.state,
        "camera_m": camera and camera.position_m,
    }


def fault(name: str, part: str, breaks: Callable[[], object], mends: Callable[[], object]) -> None:
    """Something breaks and is mended; the daemon runs on, and says so."""
    with row(name) as found:
        pid, found["before"] = service.pid, known()
        found["part before"] = (p := hub.part(part)) and p.detail
        breaks()
        found["noticed_s"] = until(
            lambda: hub.is_in(part, "degraded", "failed"), "that it is noticed", SOON_S
        )
        found["noticed"] = (p := hub.part(part)) and f"{p.state}: {p.detail}"
        found["meanwhile"] = known()
        mends()
        found["back_s"] = until(lambda: hub.is_in(part, "ok"), "that it works again", PATIENCE_S)
        found["back"] = (p := hub.part(part)) and f"{p.state}: {p.detail}"
        found["after"] = known()
        found["same process"] = service.pid == pid


def restart(name: str, sign: signal.Signals, timeout_s: float) -> None:
    """The process dies or hangs; systemd starts another, which knows everything."""
    with row(name) as found:
        pid, restarts, found["before"] = service.pid, service.restarts, known()
        begun_s = time.monotonic()
        os.kill(pid, sign)
        until(lambda: service.restarts > restarts, "that systemd starts it again", timeout_s)
        found["restarted_s"] = round(time.monotonic() - begun_s, 1)
        until(lambda: service.active and service.pid not in (0, pid), "that it is ready again", PATIENCE_S)
        found["active_s"] = round(time.monotonic() - begun_s, 1)
        found["answers_s"] = until(
            lambda: hub.device(MAC) and hub.camera(), "what was known, told again", SOON_S
        )
        found["after"] = known()
        found["parts_s"] = until(
            lambda: all(hub.is_in(part, "ok") for part in PARTS),
            "that every part is well again",
            PATIENCE_S,
        )
        lines = [line for line in service.journal(begun_s) if "vad.service" in line]
        found["systemd says"] = [line for line in lines if re.search("atchdog|killed|dumped|restart", line)]


def disk_full() -> None:
    """No room for what is learned: it is said, everything known is still told, and later it is kept."""
    with row("disk full") as found:
        pid, found["before"] = service.pid, known()
        filler = STATE / "filler"
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(1 << 16))
        found["free"] = shutil.disk_usage(STATE).free
        kept = ""
        # What SQLite has allocated already takes a few.
        for number in range(RENAMES):
            if hub.wish(DeviceWish(mac=MAC, name=f"lamp {number}")) is None:
                break
            kept = f"lamp {number}"
        found["kept while full"] = kept
        found["noticed_s"] = until(lambda: hub.is_in("store", "failed"), "that the store says so", SOON_S)
        found["noticed"] = (p := hub.part("store")) and f"{p.state}: {p.detail}"
        found["meanwhile"] = known()
        filler.unlink()
        found["back_s"] = until(lambda: hub.is_in("store", "ok"), "that the store is well again", PATIENCE_S)
        found["asked again"] = hub.wish(DeviceWish(mac=MAC, name="lamp"))
        found["name"] = (d := hub.device(MAC)) and d.name
        found["after"] = known()
        found["same process"] = service.pid == pid


def clock_stepped(name: str, step_s: float) -> None:
    """NTP finds that the clock was off."""
    with row(name) as found:
        pid, found["before"] = service.pid, known()
        before, frames = hub.status(), seen_frames()
        time.clock_settime(time.CLOCK_REALTIME, time.time() + step_s)
        until(lambda: seen_frames() > frames + FRAMES, "pictures", PATIENCE_S)
        after = hub.status()
        if before is None or after is None:
            raise StuckError("no answer")
        found["uptime_grew_s"] = round(after.uptime_s - before.uptime_s, 1)
        found["said at"] = [before.published_at, after.published_at]
        found["parts"] = {p.part: p.state for p in after.parts}
        found["after"] = known()
        found["same process"] = service.pid == pid


def seen_frames() -> int:
    """How many pictures the daemon has looked at."""
    part = hub.part("vision")
    return 0 if part is None else part.counters.get("frames", 0)


def whole() -> None:
    """Everything."""
    small_disk()
    install()
    network = Network(MAC)
    network.start_point()
    home = Home()
    home.do("camera", "plug")
    home.do("robot", "plug")
    until(lambda: Path(CAMERA).exists() and Path(ROBOT).exists(), "the devices' names", SOON_S)
    start()
    calibrate(home)
    measure(home, network)

    def told(kind: str, word: str) -> Callable[[], None]:
        return lambda: home.do(kind, word)

    fault("camera unplugged", "camera", told("camera", "unplug"), told("camera", "plug"))
    fault("robot silent", "robot", told("robot", "mute"), told("robot", "speak"))
    fault("hostapd restarted", "hostapd", network.kill_point, network.start_point)
    restart("killed", signal.SIGKILL, SOON_S)
    restart("watchdog", signal.SIGSTOP, PATIENCE_S)
    disk_full()
    clock_stepped("clock an hour ahead", 3600.0)
    clock_stepped("clock an hour back", -3600.0)
    look()
    home.end()
    network.end()
    stop()


def short() -> None:
    """Install, start, ask, stop, purge."""
    install()
    start()
    stop()


{"whole": whole, "short": short}[sys.argv[1]]()
