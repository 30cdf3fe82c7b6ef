"""`vad pki`: certificates for who reaches the hub from the network."""

from __future__ import annotations

import socket
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from vad.commands.console import EXIT_NOTHING, JsonOption, out, print_json, reported_errors
from vad.commands.run import DEFAULT_CONFIG, ConfigOption
from vad.config import load_settings, pki_folder
from vad.errors import VadError
from vad.pki.certificates import CLIENT_DAYS, Issued, Role, days_left, ends_at, utc_now
from vad.pki.credentials import ENVIRONMENT, write_credentials
from vad.pki.folder import PkiFolder
from vad.pki.register import Certificate, State, check_name, state_of

TLS_PORT = 7448
"""Where the hub listens in the examples; 7447 is the loopback router's."""
HUB = "hub"
"""The name that stands for the hub's own certificate."""

_STYLES: dict[State, str] = {
    "valid": "green",
    "ends soon": "bold yellow",
    "expired": "bold red",
    "revoked": "dim",
}
_ANYWHERE = ("0.0.0.0", "[::]")

app = typer.Typer(
    help="""Certificates for who reaches the hub from the network.

Without them the hub is reachable from itself only. To let a tablet look at the map:

  vad pki init                      # once, on the hub

  vad pki issue viewer tablet       # makes the folder ./tablet: carry it over

  add tls/0.0.0.0:7448 to bus: listen: in vad.yaml, and restart the daemon

and on the tablet:

  VAD_CREDENTIALS=tablet vad devices --endpoint tls/HUB:7448""",
    no_args_is_help=True,
)

DirOption = Annotated[
    Path | None,
    typer.Option("--dir", metavar="DIR", help="The PKI folder; else the one that the settings name."),
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", "-o", metavar="DIR", help="Where the client's folder is made; else ./NAME."),
]
DaysOption = Annotated[float, typer.Option("--days", min=0.001, help="How long it shall be good.")]
AddressOption = Annotated[
    list[str] | None,
    typer.Option("--address", metavar="HOST", help="Another name or address of the hub; repeatable."),
]
NameArgument = Annotated[str, typer.Argument(help="Who it is for: tablet, kitchen-node ...")]


@dataclass(frozen=True, slots=True)
class Place:
    """The PKI folder, the hub's name, and what the settings listen on (none where they were not read)."""

    folder: PkiFolder
    hub: str
    listen: tuple[str, ...] | None


def _place(config: Path, folder: Path | None) -> Place:
    if folder is not None:
        return Place(PkiFolder(folder), "home", None)
    settings = load_settings(config)
    return Place(PkiFolder(pki_folder(settings, config.resolve())), settings.hub, settings.bus.listen)


@app.command()
def init(
    config: ConfigOption = DEFAULT_CONFIG,
    folder: DirOption = None,
    hub: Annotated[str | None, typer.Option(help="The hub's name, where --dir is given.")] = None,
    address: AddressOption = None,
) -> None:
    """Make the hub's certificate authority and the hub's own certificate.

    Example:  sudo vad pki init --config /etc/vad/vad.yaml

    Exit code 0: made; 2: there is one already, or the folder cannot be written.
    """
    with reported_errors():
        place = _place(config, folder)
        place.folder.init(hub or place.hub, _addresses(address), utc_now())
    _print(
        f"{place.folder.path}: the authority of hub {hub or place.hub!r} and the hub's certificate are made."
    )
    _print("ca.key in it can make a certificate for anyone: keep the folder private, and a copy in a safe.")
    _print("Next:  vad pki issue viewer NAME")


@app.command()
def issue(
    role: Annotated[Role, typer.Argument(help="What it may do, see above.")],
    name: NameArgument,
    config: ConfigOption = DEFAULT_CONFIG,
    folder: DirOption = None,
    out_folder: OutOption = None,
    days: DaysOption = CLIENT_DAYS,
) -> None:
    """Make a certificate for a client, as a folder to carry to it.

    viewer: sees the map, devices, cameras' places, captures, events and the status; writes nothing; no CSI.

    agent: a remote CSI node; writes and reads below vad/HUB/agents/NAME/ only.

    admin: everything.

    Example:  vad pki issue viewer tablet

    Exit code 0: made; 2: the name is taken, or there is no authority.
    """
    with reported_errors():
        place = _place(config, folder)
        target = _free(out_folder or Path(check_name(name)))
        issued = place.folder.issue(role, name, days, utc_now())
        _hand_out(place, issued, target)


@app.command()
def revoke(
    who: Annotated[str, typer.Argument(metavar="NAME", help="A name, or one common name of `vad pki list`.")],
    config: ConfigOption = DEFAULT_CONFIG,
    folder: DirOption = None,
) -> None:
    """Take a certificate back. A running daemon stops letting it in within seconds, and cuts its connection.

    Example:  vad pki revoke tablet

    Exit code 0: revoked; 2: nobody has this name.
    """
    with reported_errors():
        taken = _place(config, folder).folder.revoke(who, utc_now())
    for certificate in taken:
        _print(f"{certificate.common_name} is revoked.")


@app.command()
def rotate(
    who: Annotated[str, typer.Argument(metavar="NAME", help="A name; `hub` is the hub's own certificate.")],
    config: ConfigOption = DEFAULT_CONFIG,
    folder: DirOption = None,
    out_folder: OutOption = None,
    days: DaysOption = CLIENT_DAYS,
    revoke_old: Annotated[
        bool, typer.Option("--revoke-old", help="End the old one now, not when it ends by itself.")
    ] = False,
    address: AddressOption = None,
) -> None:
    """Make the successor of a certificate before it ends. The daemon renews the hub's own by itself.

    The old one stays good, so that the client can be changed at leisure; revoke it by its common name then.

    Example:  vad pki rotate tablet --out tablet-new

    Exit code 0: made; 2: nobody has this name.
    """
    with reported_errors():
        place = _place(config, folder)
        now = utc_now()
        if who == HUB:
            end = place.folder.rotate_hub(_addresses([*place.folder.hub_addresses(), *(address or [])]), now)
            _print(
                f"The hub has a new certificate; it ends on {end:%Y-%m-%d}. A running daemon takes it now."
            )
            return
        target = _free(out_folder or Path(who))
        old, issued = place.folder.rotate(who, days, now, revoke_old=revoke_old)
        _hand_out(place, issued, target)
        if revoke_old:
            _print(f"{old.common_name} is revoked.")
        else:
            _print(f"The old one is good until {old.ends_at:%Y-%m-%d}:  vad pki revoke {old.common_name}")


@app.command("list")
def list_(
    config: ConfigOption = DEFAULT_CONFIG, folder: DirOption = None, as_json: JsonOption = False
) -> None:
    """Show what was issued, and how long each is good.

    Example:  vad pki list

    Exit code 0: all is well; 1: something in use ends within 30 days or has ended; 2: there is no authority.
    """
    with reported_errors():
        place = _place(config, folder)
        rows = _rows(place.folder, utc_now())
    if as_json:
        print_json([row.plain() for row in rows])
    else:
        out.print(_table(rows))
    if any(row.needs_care for row in rows):
        raise typer.Exit(EXIT_NOTHING)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the list. needs_care: it is in use, and ends soon or has ended."""

    name: str
    role: str
    common_name: str
    end: datetime
    days: float
    state: State
    needs_care: bool

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "name": self.name,
            "role": self.role,
            "common_name": self.common_name,
            "ends_at": self.end.isoformat(),
            "days_left": round(self.days, 2),
            "state": self.state,
        }


def _rows(folder: PkiFolder, now: datetime) -> list[Row]:
    files = folder.hub_files()
    own = (
        ("authority", ends_at(folder.authority_certificate())),
        (HUB, files.ends_at),
    )
    rows = [
        Row(name, name, "", end, days_left(end, now), state_of(end, now), state_of(end, now) != "valid")
        for name, end in own
    ]
    newest = {c.name: c for c in files.register.certificates if c.revoked_at is None}
    for certificate in files.register.certificates:
        rows.append(_row(certificate, now, in_use=newest.get(certificate.name) is certificate))
    return rows


def _row(certificate: Certificate, now: datetime, *, in_use: bool) -> Row:
    state = certificate.state(now)
    return Row(
        certificate.name,
        certificate.role,
        certificate.common_name,
        certificate.ends_at,
        days_left(certificate.ends_at, now),
        state,
        in_use and state in ("ends soon", "expired"),
    )


def _table(rows: list[Row]) -> Table:
    table = Table(header_style="bold", box=None, pad_edge=False)
    for name in ("Name", "Role", "Common name", "Ends"):
        table.add_column(name, no_wrap=True)
    table.add_column("Days left", justify="right", no_wrap=True)
    table.add_column("State")
    for row in rows:
        hint = f": vad pki rotate {row.name}" if row.needs_care and row.name != "authority" else ""
        left = "–" if row.state == "revoked" else f"{row.days:.0f}"
        state = Text(row.state, style=_STYLES[row.state])
        table.add_row(
            row.name, row.role, row.common_name, f"{row.end:%Y-%m-%d}", left, state.append(hint, style="dim")
        )
    return table


def _hand_out(place: Place, issued: Issued, target: Path) -> None:
    endpoint = _endpoint(place)
    write_credentials(target, issued, place.folder.authority_certificate(), endpoint)
    _print(f"{issued.common_name}, good until {issued.not_after:%Y-%m-%d}, is in the folder {target}")
    _print("Carry the folder to the client and delete it here: its private key is nowhere else. There:")
    if issued.common_name.startswith("agent."):
        _print(f"  {ENVIRONMENT}={target.name} in the agent's environment, and {endpoint} as its endpoint")
    else:
        _print(f"  {ENVIRONMENT}={target.name} vad devices --endpoint {endpoint}")
    if place.listen is not None and not any(e.startswith("tls/") for e in place.listen):
        _print(
            f"The hub does not listen on the network yet: in its settings, bus: listen: "
            f"[{', '.join((*place.listen, f'tls/0.0.0.0:{TLS_PORT}'))}], then restart the daemon."
        )


def _endpoint(place: Place) -> str:
    """Where a client finds the hub, as far as can be told here."""
    for endpoint in place.listen or ():
        protocol, _, address = endpoint.partition("/")
        host, _, port = address.rpartition(":")
        if protocol == "tls":
            return endpoint if host not in _ANYWHERE else f"tls/{_own_address()}:{port}"
    return f"tls/{_own_address()}:{TLS_PORT}"


def _addresses(more: list[str] | None) -> list[str]:
    """What the hub is called, without repetition."""
    host = socket.gethostname()
    found = [host, f"{host.partition('.')[0]}.local", "localhost", "127.0.0.1", _own_address()]
    return list(dict.fromkeys([*found, *(more or [])]))


def _own_address() -> str:
    """The address that others in the network reach this machine at; the loopback one where it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect(("192.0.2.1", 9))  # sends nothing: asks which address would be used
        return str(probe.getsockname()[0])
    return "127.0.0.1"


def _free(target: Path) -> Path:
    """`target` where a client's folder can be made; before anything is issued."""
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise VadError("is there already", where=str(target), remedy="Name another folder with --out")
    return target


def _print(sentence: str) -> None:
    out.print(sentence, markup=False, highlight=False, soft_wrap=True)
