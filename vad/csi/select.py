"""Parts and joins of packet batches; pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from vad.csi.bfee import SUBCARRIERS, empty_packets
from vad.csi.packets import CsiPackets

_ROWS = [f.name for f in fields(CsiPackets) if f.name != "csi"]


def take_packets(packets: CsiPackets, which: NDArray[np.bool_] | NDArray[np.int64]) -> CsiPackets:
    """The packets of a mask (N,) or of an index (M,); csi keeps its shape (30, R, T)."""
    return CsiPackets(**{f.name: getattr(packets, f.name)[which] for f in fields(CsiPackets)})


def join_packets(batches: Sequence[CsiPackets]) -> CsiPackets:
    """All packets one after the other; csi takes the largest R and T of the batches."""
    batches = [batch for batch in batches if len(batch)]
    if not batches:
        return empty_packets()
    rows = max(batch.csi.shape[2] for batch in batches)
    columns = max(batch.csi.shape[3] for batch in batches)
    csi = np.zeros((sum(map(len, batches)), SUBCARRIERS, rows, columns), np.complex64)
    at = 0
    for batch in batches:
        csi[at : at + len(batch), :, : batch.csi.shape[2], : batch.csi.shape[3]] = batch.csi
        at += len(batch)
    joined = {name: np.concatenate([getattr(batch, name) for batch in batches]) for name in _ROWS}
    return CsiPackets(csi=csi, **joined)
