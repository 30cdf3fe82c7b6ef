"""The session folders of one walk: devices that one card hears share a log, each remote card has its own."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vad.capture.session import SessionHeader
from vad.capture.session_writer import SessionWriter
from vad.csi.packets import CsiBatch

FloatArray = NDArray[np.float64]

OWN_CARD = ""
"""The card of this machine; others go by their agent's id."""


class WalkWriter:
    """One walk being written; `close` or `abort` ends it. All methods block, as SessionWriter's do.

    Args:
        archive: where the folders are made, named by the headers' ids.
        sessions: for each device the card that hears it, and its header.

    Attributes:
        folders: in the order of the devices.

    Raises OSError where a folder cannot be made; those that were made say so.
    """

    def __init__(self, archive: Path, sessions: Sequence[tuple[str, SessionHeader]]) -> None:
        self.folders = tuple(archive / header.id for _, header in sessions)
        self._writers: dict[str, SessionWriter] = {}
        self._of_folder: dict[Path, SessionWriter] = {}
        try:
            for card in dict.fromkeys(card for card, _ in sessions):
                first, *twins = [header for its, header in sessions if its == card]
                writer = self._writers[card] = SessionWriter(archive / first.id, first, twins)
                self._of_folder |= dict.fromkeys(writer.folders, writer)
        except OSError as error:
            with suppress(OSError):
                self.abort(f"another session folder of this walk cannot be made ({error.strerror})")
            raise

    @property
    def packets(self) -> int:
        """Of all cards together."""
        return sum(writer.packets for writer in self._writers.values())

    def packets_of(self, folder: Path) -> int:
        """The packets of that session's device so far."""
        return self._of_folder[folder].packets_of(folder)

    def append(self, batch: CsiBatch, card: str = OWN_CARD) -> None:
        """Add a batch of a card; one that hears none of the devices is left out."""
        writer = self._writers.get(card)
        if writer is not None:
            writer.append(batch)

    def lost(self, packets: int, card: str) -> None:
        """So many packets of a card will never come."""
        self._writers[card].lost(packets)

    def walk(self, t_ns: NDArray[np.int64], xy_m: FloatArray, sigma_m: FloatArray, track: int) -> None:
        """Write the walker so far: (M,), (M, 2), (M,); the next call replaces it."""
        for writer in self._writers.values():
            writer.walk(t_ns, xy_m, sigma_m, track)

    def frame(self, t_ns: int, jpeg: bytes) -> None:
        """Keep a picture."""
        for writer in self._writers.values():
            writer.frame(t_ns, jpeg)

    def close(self, t_ns: NDArray[np.int64], xy_m: FloatArray, sigma_m: FloatArray, track: int) -> None:
        """Write the whole walk (M,), (M, 2), (M,): the sessions are complete."""
        for writer in self._writers.values():
            writer.close(t_ns, xy_m, sigma_m, track)

    def abort(self, reason: str) -> None:
        """The walk is void; what was recorded stays readable."""
        for writer in self._writers.values():
            writer.abort(reason)
