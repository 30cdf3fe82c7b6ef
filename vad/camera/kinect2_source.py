"""A Kinect v2's colour camera through pyusb: one thread reads USB, one decodes. Proven on emulators only."""

from __future__ import annotations

import contextlib
import errno
import threading
import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import usb.core
import usb.util
from numpy.typing import NDArray

from vad.camera import kinect2
from vad.camera.frame import BAD_PICTURES, FrameQueue
from vad.camera.threaded import Emit, Shot, Wants, run_reopening
from vad.clock import ClockMap
from vad.errors import SourceError
from vad.health import Health

_TRANSFER_BYTES = 1 << 20
# A blocked read holds up the end of the daemon by this; 30 pictures a second come, 15 in the dark.
_READ_TIMEOUT_MS = 500
_COMMAND_TIMEOUT_MS = 1000
_SILENT_READS = 8
_END_S = 8.0
_READY_POLLS, _READY_POLL_S = 100, 0.1
_STALE_READS, _STALE_TIMEOUT_MS = 16, 20
# The decoder works on one picture, this many wait; older ones go.
_WAITING = 2
_FRACTIONS = {1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4}

# USB requests that are not pyusb's own (formats.md 9).
_SET_ISOCH_DELAY, _ISOCH_DELAY_NS = 49, 40
_SET_FEATURE, _U1_ENABLE, _U2_ENABLE, _FUNCTION_SUSPEND, _SUSPENDED = 3, 48, 49, 0, 0x0300
_TO_DEVICE, _TO_INTERFACE = 0x00, 0x01


class Kinect2Camera:
    """A Kinect v2's colour pictures; reopens by itself.

    Args:
        serial: of the one to open where several are plugged in; None takes the first.
        fraction: 1, 2 or 4: pictures of 1920x1080 divided by this (decoding them smaller costs less).
        fps: at most so many pictures a second are decoded; the sensor sends 30.
        backend: pyusb's, libusb 1.0 by default.
    """

    def __init__(
        self,
        *,
        serial: str | None = None,
        fraction: int = 2,
        fps: float = 15.0,
        part: str = "camera",
        backend: Any = None,
    ) -> None:
        if fraction not in _FRACTIONS:
            raise ValueError("fraction is 1, 2 or 4")
        self.health = Health(part)
        self._serial = serial
        self._flag = _FRACTIONS[fraction]
        self._step_ns = int(0.75e9 / fps)
        self._backend = backend

    async def run(self, out: FrameQueue) -> None:
        """Emit frames into `out` until cancelled."""
        await run_reopening(self._session, out, self.health, name="kinect2", end_s=_END_S)

    def _session(self, stop: threading.Event, emit: Emit, wants: Wants) -> None:
        device = self._find()
        try:
            with _said(), _Link(device) as link, _Decoder(self._flag, emit) as decoder:
                link.start(stop)
                self._read(link, decoder, stop, wants)
        finally:
            with contextlib.suppress(usb.core.USBError):
                usb.util.dispose_resources(device)

    def _read(self, link: _Link, decoder: _Decoder, stop: threading.Event, wants: Wants) -> None:
        assembler, clock = kinect2.PictureAssembler(), ClockMap()
        last_ns, silent, broken = 0, 0, 0
        while not stop.is_set():
            transfer = link.read_colour()
            arrival_ns = time.monotonic_ns()
            silent = silent + 1 if transfer is None else 0
            if silent >= _SILENT_READS:
                raise SourceError("the Kinect has stopped sending", remedy="unplug it and plug it in again")
            picture = assembler.receive(transfer) if transfer else None
            decoder.count("broken_pictures", assembler.broken - broken)
            broken = assembler.broken
            if picture is None:
                continue
            counter = np.array([picture.ticks * kinect2.TICK_US & 0xFFFFFFFF], np.uint32)
            t_ns = int(clock.update(counter, np.array([arrival_ns], np.int64))[0])
            decoder.count("received", 1)
            if t_ns - last_ns >= self._step_ns and wants(min(t_ns, arrival_ns)):
                last_ns = t_ns
                decoder.put(min(t_ns, arrival_ns), picture.jpeg)

    def _find(self) -> Any:
        try:
            found = usb.core.find(
                find_all=True,
                idVendor=kinect2.VENDOR,
                custom_match=lambda d: d.idProduct in kinect2.PRODUCTS,
                backend=self._backend,
            )
        except usb.core.NoBackendError as error:
            remedy = "install libusb 1.0: apt-get install libusb-1.0-0"
            raise SourceError("USB cannot be used", where="kinect2", remedy=remedy) from error
        devices = list(found)
        if self._serial is not None:
            with _said():
                devices = [d for d in devices if usb.util.get_string(d, d.iSerialNumber) == self._serial]
        if not devices:
            which = f" with the serial number {self._serial}" if self._serial else ""
            remedy = "it needs its own power supply and a USB 3 port"
            raise SourceError(f"there is no Kinect v2{which}", where="kinect2", remedy=remedy)
        return devices[0]


class _Link:
    """An opened Kinect: commands and colour transfers. USBError where it has gone."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self._sequence = 0
        self.serial = ""

    def __enter__(self) -> _Link:
        device = self._device
        if _configuration(device) != 1:
            device.set_configuration(1)
        for interface in (0, 1):
            usb.util.claim_interface(device, interface)
        device.ctrl_transfer(_TO_DEVICE, _SET_ISOCH_DELAY, _ISOCH_DELAY_NS, 0)
        device.set_interface_altsetting(1, 0)
        for feature in (_U1_ENABLE, _U2_ENABLE):
            device.ctrl_transfer(_TO_DEVICE, _SET_FEATURE, feature, 0)
        self._suspend(True)
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        # What can still be told it is told, so that the next opening finds it at rest.
        with contextlib.suppress(usb.core.USBError, SourceError):
            # After an error it may be gone, and then libusb 1.0.26 (Debian 12) keeps a lock in this call and
            # aborts the whole process when the device is closed. The kernel does the same at closing.
            if kind is None:
                self._device.set_interface_altsetting(1, 0)
            for command in kinect2.CLOSING:
                self._ask(command)
            self._suspend(True)

    def start(self, stop: threading.Event) -> None:
        """Until colour pictures come."""
        self._suspend(False)
        self._forget()
        for command in kinect2.OPENING:
            if stop.is_set():
                return
            answer = self._ask(command)
            if command is kinect2.SERIAL:
                self.serial = kinect2.serial_number(answer)
        for _ in range(_READY_POLLS):
            if kinect2.is_ready(self._ask(kinect2.READY)):
                break
            if stop.wait(_READY_POLL_S):
                return
        else:
            remedy = "unplug it, wait ten seconds, plug it in again"
            raise SourceError("the Kinect does not get ready", where=self.serial, remedy=remedy)
        self._ask(kinect2.INITIALISE)
        self._device.set_interface_altsetting(1, 1)
        self._ask(kinect2.STREAM)

    def read_colour(self) -> bytes | None:
        """The next transfer of the colour endpoint; None where none came in time."""
        try:
            return bytes(self._device.read(kinect2.ENDPOINT_COLOUR, _TRANSFER_BYTES, _READ_TIMEOUT_MS))
        except usb.core.USBTimeoutError:
            return None

    def _ask(self, command: kinect2.Command) -> bytes:
        sequence, self._sequence = self._sequence, self._sequence + 1
        self._device.write(kinect2.ENDPOINT_COMMANDS, command.to_bytes(sequence), _COMMAND_TIMEOUT_MS)
        data = b""
        if command.answer_bytes:
            data = bytes(
                self._device.read(kinect2.ENDPOINT_ANSWERS, command.answer_bytes, _COMMAND_TIMEOUT_MS)
            )
        closing = self._device.read(kinect2.ENDPOINT_ANSWERS, kinect2.ANSWER_BYTES, _COMMAND_TIMEOUT_MS)
        kinect2.check_answer(bytes(closing), sequence)
        return data

    def _forget(self) -> None:
        """Read away what an earlier, broken-off conversation left."""
        with contextlib.suppress(usb.core.USBTimeoutError):
            for _ in range(_STALE_READS):
                self._device.read(kinect2.ENDPOINT_ANSWERS, 0x200, _STALE_TIMEOUT_MS)

    def _suspend(self, suspended: bool) -> None:
        index = _SUSPENDED if suspended else 0
        self._device.ctrl_transfer(_TO_INTERFACE, _SET_FEATURE, _FUNCTION_SUSPEND, index)


class _Decoder:
    """A thread that decodes the newest pictures while the next ones are read."""

    def __init__(self, flag: int, emit: Emit) -> None:
        self._flag = flag
        self._emit = emit
        self._waiting: list[tuple[int, bytes]] = []
        self._counts: dict[str, int] = {}
        self._ended = False
        self._change = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="kinect2 decode", daemon=True)

    def __enter__(self) -> _Decoder:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        with self._change:
            self._ended = True
            self._change.notify()
        self._thread.join()

    def put(self, t_ns: int, jpeg: bytes) -> None:
        with self._change:
            if len(self._waiting) >= _WAITING:
                del self._waiting[0]
                self._add("undecoded", 1)
            self._waiting.append((t_ns, jpeg))
            self._change.notify()

    def count(self, what: str, number: int) -> None:
        """Add to a counter; it goes out with the next picture."""
        if number:
            with self._change:
                self._add(what, number)

    def _add(self, what: str, number: int) -> None:
        self._counts[what] = self._counts.get(what, 0) + number

    def _work(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._ended or self._waiting)
                if self._ended:
                    return
                t_ns, jpeg = self._waiting.pop(0)
                counts, self._counts = self._counts, {}
            image = _decode(jpeg, self._flag)
            if image is None:
                self.count(BAD_PICTURES, 1)
                for what, number in counts.items():
                    self.count(what, number)
                continue
            height, width = image.shape[:2]
            try:
                self._emit(Shot(t_ns, image, f"Kinect v2, {width}x{height}, stamps: sensor", counts))
            except RuntimeError:  # the loop has gone
                return


def _decode(jpeg: bytes, flag: int) -> NDArray[np.uint8] | None:
    try:
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), flag)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def _configuration(device: Any) -> int | None:
    try:
        return int(device.get_active_configuration().bConfigurationValue)
    except usb.core.USBError as error:
        if error.errno in (errno.ENODEV, errno.EACCES):
            raise
        return None  # not configured yet


@contextlib.contextmanager
def _said() -> Iterator[None]:
    """USB's errors in words that help."""
    try:
        yield
    except usb.core.USBError as error:
        if error.errno == errno.EACCES:
            what, remedy = (
                "the Kinect may not be opened",
                "install the udev rule systemd/70-vad.rules",
            )
        elif error.errno in (errno.ENODEV, errno.EIO, errno.EPIPE, errno.EPROTO):
            what, remedy = "the Kinect was unplugged", ""
        elif error.errno == errno.EBUSY:
            what, remedy = "another program uses the Kinect", ""
        else:
            what, remedy = f"the Kinect does not answer ({error})", "unplug it and plug it in again"
        raise SourceError(what, where="kinect2", remedy=remedy) from error
    except ValueError as error:
        # pyusb's get_string where the languages may not be read
        raise SourceError("the Kinect may not be opened", where="kinect2", remedy=str(error)) from error
