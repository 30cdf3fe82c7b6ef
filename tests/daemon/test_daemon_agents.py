"""The paper's layout through the whole hub: the card is at the unknown device, its CSI comes over zenoh."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest
from daemon_world import settings_for
from home_time import LATENCY_NS, HomeTime
from waiting import free_port, running, until

from vad.agent.info import AgentInfo
from vad.agent.node import Node
from vad.bus.node import Bus
from vad.bus.session import BusSettings
from vad.camera.frame import Frame, FrameQueue
from vad.capture.session import load_session
from vad.csi.follow import FollowLog
from vad.daemon.agents import Agents
from vad.daemon.captures import Captures
from vad.daemon.ears import Ears
from vad.daemon.eyes import Eyes
from vad.daemon.registry import Registry
from vad.sim.calibration import true_calibration
from vad.sim.driver import FifoSender, run
from vad.sim.home import floor_plan
from vad.sim.radio import Radio, RadioBatch
from vad.sim.render import Renderer
from vad.sim.scenario import make_home
from vad.store.worker import StoreWorker
from vad.vision.people import PoseNetwork

HOME = make_home(1)
NODE_MAC = HOME.device_mac
WALK = HOME.walks[0]
S = 1_000_000_000


class FollowedRadio(Radio):
    """A radio that tells how far it has been played."""

    made_s = 0.0

    def generate(self, t0_s: float, t1_s: float) -> RadioBatch:
        made = super().generate(t0_s, t1_s)
        self.made_s = t1_s
        return made


@pytest.mark.slow
@pytest.mark.timeout(600)
async def test_a_walk_past_a_remote_card_places_it(tmp_path: Path) -> None:
    limits = {"min_s": 3.0, "max_s": 6.0, "mapped_radius_m": 5.0, "min_walks": 1}
    settings, plan, port = settings_for(tmp_path, capture=limits), floor_plan(HOME), free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    renderer = await asyncio.to_thread(Renderer, HOME)
    radio = FollowedRadio(HOME, seed=1, array_end="device")
    network = await asyncio.to_thread(PoseNetwork)
    with HomeTime() as clock:
        async with StoreWorker(tmp_path / "vad.sqlite") as store, Bus(BusSettings(listen=(endpoint,))) as bus:
            eyes = Eyes(
                network,
                max_fps=10.0,
                focal_px=None,
                known=true_calibration(HOME),
                on_calibration=lambda _: None,
            )
            registry, agents = Registry(settings, plan, bus, store), Agents(bus.keys)
            await registry.load()
            captures = Captures(settings, tmp_path, plan, eyes, Ears(), registry, bus, agents)
            frames = FrameQueue(2)
            sender = FifoSender(tmp_path / "csi.fifo")
            node = Node(
                BusSettings(mode="client", listen=(), connect=(endpoint,)),
                AgentInfo(id="attic", mac=NODE_MAC),
                FollowLog(tmp_path / "csi.fifo"),
                batch_s=0.05,
                buffer_bytes=32_000_000,
            )
            await registry.joined(NODE_MAC, "attic")
            async with running(eyes.run(frames), agents.run(bus.session), captures.run(), node.run()):
                await until(lambda: agents.card_of(NODE_MAC) is not None, "the agent is there")
                clock.stand()
                start_ns = clock.now_ns() - int((WALK.start_s + 2.0) * S)
                seen = 0

                async def show(t_ns: int) -> None:
                    nonlocal seen
                    seen = eyes.frames
                    exposed_ns = t_ns - LATENCY_NS
                    image = await asyncio.to_thread(renderer.frame, (exposed_ns - start_ns) / S)
                    frames.put(Frame(exposed_ns, seen, image))

                def kept_up() -> bool:
                    return eyes.frames > seen and radio.made_s >= (clock.now_ns() - start_ns) / S

                async with running(clock.play(show, kept_up), run(radio, start_ns, sender)):
                    await until(lambda: registry.get(NODE_MAC).state == "capturing", "a walker is seen", 200)
                    await until(lambda: registry.get(NODE_MAC).walks == 1, "the walk is solved", 200)
            place = registry.get(NODE_MAC).estimate
    *_, folder = sorted((tmp_path / "sessions").iterdir())  # a busy network may need a second try
    capture = json.loads((folder / "session.json").read_text())["capture"]
    assert (capture["state"], capture.get("lost_packets")) == ("done", None)
    session = load_session(folder)
    assert session.header.radio.array_end == "device"
    assert session.header.device.mac == NODE_MAC
    assert session.csi.shape[1:] == (30, 3, 1)
    assert session.t_ns[0] <= session.walk_t_ns[0]
    assert session.t_ns[-1] >= session.walk_t_ns[-1]
    assert len(session.t_ns) > 1500
    assert place is not None
    error_m = np.hypot(place.x_m - HOME.device_m[0], place.y_m - HOME.device_m[1])
    assert error_m < max(1.5, place.radius90_m)
