"""`vad sessions`: the recorded walks: list, show, export, delete, replay; and the log of decisions."""

from __future__ import annotations

import tarfile
import time
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.table import Table
from rich.text import Text

from vad.capture.archive import SessionEntry, remove, sessions_in, total_bytes
from vad.capture.session import load_session
from vad.capture.session_writer import FRAMES, LOG
from vad.commands.console import EXIT_NOTHING, JsonOption, complain, out, print_json, reported_errors
from vad.commands.run import DEFAULT_CONFIG
from vad.config import load_settings, resolve
from vad.daemon import decisions
from vad.errors import SessionError, VadError
from vad.mac import normal_mac
from vad.report.words import metres, printable

LAST = "last"
STILL_WRITTEN_S = 30.0
"""A session in the state `recording` whose log has not grown for so long was cut off by a crash."""

sessions_app = typer.Typer(
    no_args_is_help=True, help="Recorded walks: list, show, export, delete, replay; and why each was made."
)

ConfigOption = Annotated[
    Path,
    typer.Option("--config", "-c", help="The daemon's settings: where its state is.", envvar="VAD_CONFIG"),
]
StateOption = Annotated[
    Path | None, typer.Option("--state-dir", help="The state folder itself, instead of the settings.")
]
IdArgument = Annotated[
    list[str],
    typer.Argument(help="Sessions: an id, a part of it that no other has, or `last`.", metavar="ID..."),
]
DeviceOption = Annotated[str | None, typer.Option(help="Only those of this device: its MAC or its name.")]

_STYLES = {"done": "green", "aborted": "yellow", "recording": "bold cyan", "unknown": "red"}


@sessions_app.command("list")
def list_(
    as_json: JsonOption = False,
    device: DeviceOption = None,
    state: Annotated[
        list[str] | None, typer.Option(help="Only in this state (may repeat): recording, done, aborted.")
    ] = None,
    config: ConfigOption = DEFAULT_CONFIG,
    state_dir: StateOption = None,
) -> None:
    """List the recorded walks, the oldest first: which device, how long, what it said, what it takes.

    Example:  vad sessions list --device lamp

    Exit code 0: there are some; 1: none; 2: the folder or the settings cannot be read.
    """
    with reported_errors():
        found = _chosen(_all(config, state_dir), device, state)
    if as_json:
        print_json([_record(session) for session in found])
    elif found:
        out.print(_table(found))
        size = _size(total_bytes(found))
        out.print(f"{len(found)} session{'s' if len(found) > 1 else ''}, {size} on the disk", highlight=False)
    else:
        complain("there is no such session" if device or state else "nothing has been recorded yet")
    if not found:
        raise typer.Exit(EXIT_NOTHING)


@sessions_app.command()
def show(
    ids: IdArgument,
    as_json: JsonOption = False,
    config: ConfigOption = DEFAULT_CONFIG,
    state_dir: StateOption = None,
) -> None:
    """Show what is in a session: packets, walk, how it ended, what it said, what is damaged.

    Example:  vad sessions show last

    Exit code 0: it can be solved; 1: it is void or damaged; 2: there is no such session.
    """
    with reported_errors():
        wanted = _named(_all(config, state_dir), ids)
    records = [_details(session) for session in wanted]
    if as_json:
        print_json(records)
    else:
        for record in records:
            table = Table(box=None, show_header=False, pad_edge=False)
            table.add_column(style="bold", no_wrap=True)
            table.add_column(overflow="fold")
            for name, value in record.items():
                if value not in (None, "", []):
                    shown = "\n".join(map(str, value)) if isinstance(value, list) else str(value)
                    table.add_row(name.replace("_", " "), Text(printable(shown)))
            out.print(table)
    if not all(record["usable"] for record in records):
        raise typer.Exit(EXIT_NOTHING)


@sessions_app.command()
def export(
    ids: IdArgument,
    target: Annotated[
        Path | None, typer.Option("--to", help="The archive to write.", metavar="FILE.tar.gz")
    ] = None,
    frames: Annotated[bool, typer.Option("--frames", help="The pictures, too: people are on them.")] = False,
    config: ConfigOption = DEFAULT_CONFIG,
    state_dir: StateOption = None,
) -> None:
    """Pack sessions into a .tar.gz, to keep or to pass on; `vad replay` reads them again when unpacked.

    Example:  vad sessions export last --to walk.tar.gz

    Exit code 0: written; 2: there is no such session, or the file cannot be written.
    """
    with reported_errors():
        wanted = _named(_all(config, state_dir), ids)
        path = target or Path(f"{wanted[0].id}.tar.gz")
        try:
            with tarfile.open(path, "x:gz") as archive:
                for session in wanted:
                    for file in sorted(session.folder.rglob("*")):
                        inside = file.relative_to(session.folder)
                        if file.is_file() and (frames or inside.parts[0] != FRAMES):
                            # Each session whole: a hard link between two of them is no file by itself.
                            member = archive.gettarinfo(file, str(Path(session.id) / inside))
                            member.type, member.linkname = tarfile.REGTYPE, ""
                            member.size = file.stat().st_size
                            member.uname = member.gname = ""
                            with file.open("rb") as content:
                                archive.addfile(member, content)
        except FileExistsError:
            raise VadError("is there already", where=str(path), remedy="Name another with --to") from None
        except OSError as error:
            raise VadError(f"cannot be written ({error.strerror})", where=str(path)) from error
    size = _size(path.stat().st_size)
    out.print(f"{path}: {len(wanted)} session{'s' if len(wanted) > 1 else ''}, {size}", markup=False)


@sessions_app.command()
def delete(
    ids: Annotated[
        list[str] | None,
        typer.Argument(help="Sessions, as in `show`.", metavar="[ID...]", show_default=False),
    ] = None,
    aborted: Annotated[bool, typer.Option("--aborted", help="All that are void.")] = False,
    device: DeviceOption = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    config: ConfigOption = DEFAULT_CONFIG,
    state_dir: StateOption = None,
) -> None:
    """Delete sessions for good. What the daemon knows of the devices stays.

    Example:  vad sessions delete --aborted --yes

    Exit code 0: deleted; 1: nothing fits, or you said no; 2: one cannot be deleted (it is being recorded).
    """
    with reported_errors():
        known = _all(config, state_dir)
        if ids:
            wanted = _named(known, ids)
        elif aborted or device is not None:
            wanted = _chosen(known, device, ["aborted"] if aborted else None)
        else:
            raise VadError("nothing is named", remedy="Name sessions, --aborted or --device")
        for session in wanted:
            if _still_written(session):
                raise SessionError("it is being recorded", where=session.id, remedy="Wait until it is done")
        if not wanted:
            complain("there is no such session")
            raise typer.Exit(EXIT_NOTHING)
        for session in wanted:
            out.print(f"{session.id}  {session.state}  {_size(session.bytes)}", highlight=False)
        many = f"{len(wanted)} session{'s' if len(wanted) > 1 else ''}"
        if not yes and not typer.confirm(f"Delete {many} for good?"):
            raise typer.Exit(EXIT_NOTHING)
        for session in wanted:
            remove(session)
    out.print(f"{many} deleted")


@sessions_app.command()
def replay(
    ids: IdArgument,
    as_json: JsonOption = False,
    fuse: Annotated[bool, typer.Option("--fuse", help="Multiply the sessions of one device.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Pictures of each session into this folder.")] = None,
    config: ConfigOption = DEFAULT_CONFIG,
    state_dir: StateOption = None,
) -> None:
    """Solve recorded sessions again, as `vad replay` does with folders.

    Example:  vad sessions replay last --plot pictures/

    Exit code 0: solved; 1: no device could be placed; 2: a session cannot be read.
    """
    from vad.commands.replay import replay as replay_folders  # the estimator takes a second to import

    with reported_errors():
        wanted = _named(_all(config, state_dir), ids)
    replay_folders([s.folder for s in wanted], as_json=as_json, fuse_walks=fuse, plot=plot, bounds=None)


@sessions_app.command()
def log(
    as_json: JsonOption = False,
    device: DeviceOption = None,
    lines: Annotated[int, typer.Option("--lines", "-n", min=1, help="The last so many.")] = 50,
    config: ConfigOption = DEFAULT_CONFIG,
    state_dir: StateOption = None,
) -> None:
    """Tell why: who was measured when, who had to wait and for what, who was moved. The newest last.

    Example:  vad sessions log --device lamp -n 20

    Exit code 0: there is something to tell; 1: nothing; 2: it cannot be read.
    """
    with reported_errors():
        folder = _state(config, state_dir)
        try:
            told = decisions.read(folder)
        except OSError as error:
            raise VadError(f"cannot be read ({error.strerror})", where=str(folder)) from error
        if device is not None:
            macs = _macs_called(sessions_in(folder / "sessions"), device)
            told = [line for line in told if line.mac in macs or device in line.text]
    told = told[-lines:]
    if as_json:
        print_json([msgspec.to_builtins(line) for line in told])
    else:
        for line in told:
            at = datetime.fromisoformat(line.at).astimezone()
            out.print(Text(f"{at:%Y-%m-%d %H:%M:%S}  {printable(line.text)}"), soft_wrap=True)
    if not told:
        complain("no decision has been written down" + ("" if device is None else " for that device"))
        raise typer.Exit(EXIT_NOTHING)


def _state(config: Path, state_dir: Path | None) -> Path:
    if state_dir is not None:
        return state_dir
    return resolve(load_settings(config).state_dir, config.resolve())


def _all(config: Path, state_dir: Path | None) -> list[SessionEntry]:
    return sessions_in(_state(config, state_dir) / "sessions")


def _macs_called(sessions: list[SessionEntry], device: str) -> set[str | None]:
    try:
        return {normal_mac(device)}
    except VadError:
        return {session.mac for session in sessions if session.name == device}


def _chosen(sessions: list[SessionEntry], device: str | None, state: list[str] | None) -> list[SessionEntry]:
    if device is not None:
        macs = _macs_called(sessions, device)
        sessions = [s for s in sessions if s.mac in macs and s.mac is not None]
    return [s for s in sessions if not state or s.state in state]


def _named(sessions: list[SessionEntry], ids: list[str]) -> list[SessionEntry]:
    """The sessions that were asked for, each once; SessionError for one that is none or several."""
    found: dict[str, SessionEntry] = {}
    for wanted in ids:
        hits = [s for s in sessions if s.id == wanted] or [s for s in sessions if wanted in s.id]
        if wanted == LAST:
            hits = sessions[-1:]
        if not hits:
            raise SessionError("no such session", where=wanted, remedy="`vad sessions list` names them")
        if len(hits) > 1:
            several = ", ".join(s.id for s in hits[:3])
            raise SessionError(f"several sessions are called so: {several}", where=wanted)
        found[hits[0].id] = hits[0]
    return list(found.values())


def _still_written(session: SessionEntry) -> bool:
    if session.state != "recording":
        return False
    try:
        return time.time() - (session.folder / LOG).stat().st_mtime < STILL_WRITTEN_S
    except OSError:
        return False


def _record(session: SessionEntry) -> dict[str, Any]:
    return {
        "id": session.id,
        "folder": str(session.folder),
        "begun": None if session.begun is None else session.begun.isoformat(),
        "mac": session.mac,
        "name": session.name,
        "source": session.source,
        "state": session.state,
        "reason": session.reason,
        "packets": session.packets,
        "walk_s": session.walk_s,
        "result": None if session.result is None else msgspec.to_builtins(session.result),
        "bytes": session.bytes,
    }


def _details(session: SessionEntry) -> dict[str, Any]:
    """Everything that the files tell; `usable` where the session can be solved."""
    record = _record(session) | {"begun": _when(session), "size": _size(session.bytes)}
    result = record.pop("result")
    record["said"] = "" if result is None else result["note"]
    record["notes"], record["usable"] = [], session.state == "done"
    try:
        loaded = load_session(session.folder)
    except SessionError as error:
        return record | {"notes": [str(error)], "usable": False}
    length_m = sum(((loaded.walk_xy_m[1:] - loaded.walk_xy_m[:-1]) ** 2).sum(axis=1) ** 0.5)
    header = loaded.header
    return record | {
        "packets_of_device": len(loaded.t_ns),
        "antennas": loaded.csi.shape[2],
        "walked_m": round(float(length_m), 1),
        "anchor_m": f"{header.anchor.x_m:.2f}, {header.anchor.y_m:.2f}",
        "carrier_ghz": round(header.radio.carrier_hz / 1e9, 4),
        "map_epoch": header.map.epoch,
        "notes": loaded.notes,
        "usable": session.state == "done" and not loaded.damage,
    }


def _when(session: SessionEntry) -> str:
    return "" if session.begun is None else f"{session.begun.astimezone():%Y-%m-%d %H:%M:%S}"


def _table(sessions: list[SessionEntry]) -> Table:
    table = Table(header_style="bold", box=None, pad_edge=False)
    table.add_column("Session", no_wrap=True)
    table.add_column("Device", overflow="fold")
    table.add_column("Began", no_wrap=True)
    for name in ("walk s", "packets", "size", "±90 % m"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("State", no_wrap=True)
    table.add_column("What it said", overflow="fold", ratio=1)
    for session in sessions:
        result = session.result
        said = session.reason or ("" if result is None else result.note)
        table.add_row(
            session.id,
            Text(printable(session.name or session.mac or "–")),
            _when(session) or "–",
            "–" if session.walk_s is None else f"{session.walk_s:.0f}",
            "–" if session.packets is None else str(session.packets),
            _size(session.bytes),
            metres(None if result is None else result.radius90_m, "±"),
            Text(session.state, style=_STYLES.get(session.state, "")),
            Text(printable(said), style="dim"),
        )
    return table


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 100_000 else f"{count / 1e3:.1f} kB"
