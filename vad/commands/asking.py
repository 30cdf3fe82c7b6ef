"""Questions on a terminal: plain lines, so that they work over every connection and in every locale."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import typer

from vad.commands.console import complain, err, out
from vad.errors import VadError
from vad.report.words import printable


class Asker:
    """Asks, or takes the default where nobody is to be asked.

    Args:
        silent: ask nothing. aside: talk on standard error, because standard output is for a file.
    """

    def __init__(self, *, silent: bool, aside: bool = False) -> None:
        self.silent = silent
        self._aside = aside
        self.console = err if aside else out

    def say(self, line: str = "") -> None:
        """A line that is no question."""
        self.console.print(printable(line), markup=False, highlight=False, soft_wrap=True)

    def choose(self, question: str, options: Sequence[str], default: int = 0) -> int:
        """Which option, as an index; where there is only one it is taken without a question."""
        if self.silent or len(options) < 2:
            return default
        self.say()
        self.say(question)
        for number, option in enumerate(options, start=1):
            self.say(f"  {number}. {option}")
        while True:
            answer: int = typer.prompt("Number", default=default + 1, type=int, err=self._aside)
            if 1 <= answer <= len(options):
                return answer - 1
            complain(f"{answer} is not among 1 to {len(options)}")

    def confirm(self, question: str, *, default: bool) -> bool:
        """Yes or no."""
        return default if self.silent else typer.confirm(question, default=default, err=self._aside)

    def text(self, question: str, default: str, check: Callable[[str], object] = str) -> str:
        """A line; asked again until `check` raises no VadError."""
        while True:
            answer = default
            if not self.silent:
                answer = typer.prompt(question, default=default or None, err=self._aside)
            try:
                check(answer)
            except VadError as error:
                if self.silent:
                    raise
                complain(str(error))
                continue
            return answer
