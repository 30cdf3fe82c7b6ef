"""The process that solves sessions for the daemon: requests on standard input, answers on standard output.

    request  one line of JSON: {"folder": ...}
    answer   8 bytes, the length (big-endian); a pickle of SolvedWalk or of the SessionError's three texts

It ends when its input does: when the daemon closed it, or died.
"""

from __future__ import annotations

import os
import pickle
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec

from vad.errors import SessionError
from vad.mapping.evidence import Terms
from vad.mapping.posterior import Grid, Posterior
from vad.solve import GRID_STEP_M, bounds_of, solve_session

NICE = 5
"""Seeing goes before solving: frames that are left out are lost, a place may come some seconds later."""


class SolveRequest(msgspec.Struct, frozen=True):
    """folder: of the session."""

    folder: str


@dataclass(frozen=True, slots=True)
class SolvedWalk:
    """What a session says of its device, without its packets.

    status, reason: of the evidence (vad.mapping.device_stage); terms: compact, None where refused; packets:
    of the device; walk_s: the walk's length; epoch: of the map.
    """

    status: str
    reason: str
    terms: Terms | None
    packets: int
    walk_s: float
    epoch: int

    @property
    def posterior(self) -> Posterior | None:
        """What this walk alone says."""
        return None if self.terms is None else self.terms.posterior(self.terms.grid)


def solved_walk(folder: Path) -> SolvedWalk:
    """Solve a session folder here and now; about a second of work. Raises SessionError."""
    solved = solve_session(folder)
    session, evidence = solved.session, solved.evidence
    grid = Grid.over(bounds_of(session), GRID_STEP_M)
    return SolvedWalk(
        evidence.status,
        evidence.reason,
        None if evidence.terms is None else evidence.terms.compact(grid),
        len(session.t_ns),
        float(session.walk_t_ns[-1] - session.walk_t_ns[0]) / 1e9,
        session.header.map.epoch,
    )


def main() -> None:
    """Serve until the input ends."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints is no answer
    os.nice(NICE)
    cv2.setNumThreads(1)
    for line in sys.stdin.buffer:
        request = msgspec.json.decode(line, type=SolveRequest)
        answer: SolvedWalk | tuple[str, str, str]
        try:
            answer = solved_walk(Path(request.folder))
        except SessionError as error:
            answer = (error.what, error.where, error.remedy)
        packed = pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL)
        answers.write(len(packed).to_bytes(8, "big") + packed)
        answers.flush()
