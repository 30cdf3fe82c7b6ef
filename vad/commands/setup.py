"""`vad setup`: the first run. Looks around, asks little, writes the settings, says what comes next."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from vad.commands.asking import Asker
from vad.commands.console import (
    EXIT_NOTHING,
    JsonOption,
    complain,
    out,
    print_json,
    reported_errors,
)
from vad.commands.doctor import doctor
from vad.commands.run import DEFAULT_CONFIG, ConfigOption
from vad.commands.setup_questions import ask_camera, ask_network, ask_plan, ask_robot
from vad.config import load_settings, parse_yaml, read_text
from vad.errors import ConfigError
from vad.setup.draft import Draft, check_writable, write_settings
from vad.setup.surroundings import Surroundings, look_around
from vad.setup.tables import found_table

LAN_S = 1.5


def setup(
    config: ConfigOption = DEFAULT_CONFIG,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Ask nothing: take what is found.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show the settings, write nothing.")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="With --yes: replace settings that are there; a backup stays.")
    ] = False,
    check: Annotated[bool, typer.Option(help="Try everything afterwards (vad doctor).")] = True,
    as_json: JsonOption = False,
    root: Annotated[Path, typer.Option(hidden=True)] = Path("/"),
) -> None:
    """Find cameras, robots and the access point here, ask what is not clear, write the settings.

    Nothing is changed before the end, and Ctrl-C at any question leaves everything as it was. What is missing
    (a robot, the CSI card) may come later: the settings are usable without it, and say so.

    Example:  sudo vad setup

    Exit code 0: written, or shown with --dry-run; 1: nothing was written, or the check found something;
    2: the file cannot be written.
    """
    silent = yes or as_json
    with reported_errors(), _errors_only():
        if not dry_run:
            check_writable(config)
        before = _before(config)
        if before is not None and silent and not (dry_run or overwrite):
            complain(
                f"{config} is there already: nothing was written. --overwrite replaces it and keeps a backup"
            )
            raise typer.Exit(EXIT_NOTHING)
        ask = Asker(silent=silent, aside=dry_run)
        found = _look(ask, root, config, quiet=as_json)
        draft = Draft(dict(before or {}))
        try:
            _ask_all(ask, found, draft, config, dry_run=dry_run)
            text = draft.text()
            if not dry_run and not _may_write(ask, config):
                raise typer.Abort
        except typer.Abort:
            complain("nothing was written")
            raise typer.Exit(EXIT_NOTHING) from None
        backup = None if dry_run else write_settings(text, config, datetime.now().astimezone())
        if as_json:
            print_json(_as_json(found, draft, None if dry_run else config, backup))
            return
    if dry_run:
        sys.stdout.buffer.write(text.encode())  # the same bytes in every locale: this may go into a file
        return
    _tell(draft, config, backup)
    with _errors_only():
        _check_and_say_next(config, check=check)


@contextmanager
def _errors_only() -> Iterator[None]:
    """What is wrong is said here, once; the parts that are tried need not say it, too."""
    logger = logging.getLogger("vad")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def _before(config: Path) -> dict[str, Any] | None:
    """The settings that are there, plain; None where there are none, empty where they cannot be used."""
    if not config.exists():
        return None
    try:
        load_settings(config)
    except ConfigError as error:
        complain(f"the settings that are there cannot be used and are not built upon: {error}")
        return {}
    return {
        key: value
        for key, value in parse_yaml(read_text(config), where=str(config)).items()
        if value is not None
    }


def _look(ask: Asker, root: Path, config: Path, *, quiet: bool) -> Surroundings:
    if not quiet:
        ask.say("Looking around ...")
    found = look_around(root, config.parent, LAN_S if root == Path("/") else 0.0)
    if not quiet:
        ask.console.print(found_table(found))
    return found


def _ask_all(ask: Asker, found: Surroundings, draft: Draft, config: Path, *, dry_run: bool) -> None:
    folder = Path.cwd() if dry_run else config.parent
    ask_camera(ask, found, draft, folder)
    ask_robot(ask, found, draft)
    ask_network(ask, found, draft)
    ask_plan(ask, found, draft, config.parent)


def _may_write(ask: Asker, config: Path) -> bool:
    if not config.exists():
        return ask.confirm(f"Write {config}?", default=True)
    return ask.silent or ask.confirm(
        f"Replace {config}? The one that is there is kept beside it", default=False
    )


def _tell(draft: Draft, config: Path, backup: Path | None) -> None:
    out.print()
    out.print(f"wrote {config}", markup=False, highlight=False, soft_wrap=True)
    if backup is not None:
        out.print(f"what was there is now {backup}", markup=False, highlight=False, soft_wrap=True)
    for sentence in draft.missing:
        out.print(f"! {sentence}", style="yellow", markup=False, highlight=False, soft_wrap=True)


def _check_and_say_next(config: Path, *, check: bool) -> None:
    well = True
    if check:
        out.print("\nTrying it (vad doctor) ...", highlight=False)
        try:
            doctor(config)
        except typer.Exit as ended:
            well = not ended.exit_code
    named = "" if config == DEFAULT_CONFIG else f" --config {config}"
    if not well:
        following = f"mend what is marked above, then: vad doctor{named}"
    elif config == DEFAULT_CONFIG:
        following = "sudo vad install (starts the service, confined to what these settings name); vad status"
    else:
        following = f"vad run{named}"
    out.print(f"\nNext: {following}", markup=False, highlight=False, soft_wrap=True)
    if not well:
        raise typer.Exit(EXIT_NOTHING)


def _as_json(found: Surroundings, draft: Draft, written: Path | None, backup: Path | None) -> dict[str, Any]:
    plain = msgspec.to_builtins(found, builtin_types=(Path,), enc_hook=str)
    return {
        "found": plain,
        "settings": draft.chosen,
        "missing": draft.missing,
        "written": None if written is None else str(written),
        "backup": None if backup is None else str(backup),
    }
