"""`vad install`, `vad uninstall`: vad as a service of systemd."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from vad.commands.console import out, reported_errors
from vad.commands.service_files import (
    AGENT_UNIT,
    FILES,
    FOLDERS,
    HUB_UNIT,
    USERS,
    ServiceFile,
    is_packaged,
    write_packaged,
)
from vad.commands.system_steps import Steps, answer_of
from vad.config import agent_settings, load_settings, parse_yaml, read_text
from vad.errors import VadError

UNITS = Path("/etc/systemd/system")
HUB_SETTINGS, AGENT_SETTINGS = Path("/etc/vad/vad.yaml"), Path("/etc/vad/agent.yaml")
_PRIVATE = ("/home/", "/root/", "/tmp/", "/var/tmp/", "/run/user/")
"""Where a service sees nothing."""
_WORD = 14
_DRY = {"wrote": "write", "changed": "change", "removed": "remove", "linked": "link", "ran": "run"}

DryOption = Annotated[bool, typer.Option("--dry-run", help="Say what would be done; do nothing.")]
AgentOption = Annotated[
    bool, typer.Option("--agent", help="The agent of a remote card (vad agent) instead of the daemon.")
]


def install(
    agent: AgentOption = False,
    dry_run: DryOption = False,
    start: Annotated[bool, typer.Option(help="Start it, too, where its settings are there.")] = True,
    root: Annotated[
        Path | None,
        typer.Option(help="Only put the files below DIR, as a package has them.", metavar="DIR"),
    ] = None,
) -> None:
    """Make vad a service: it starts with the hub, is confined to what it needs, and watched.

    Writes the unit, its user, folders and device rules (those of the Debian package are there already);
    checks the settings and narrows the service to the hosts and devices they name; enables and starts it.
    Run it again after you changed hosts or devices there. It never writes settings: `vad setup` does.

    sudo vad install              the daemon, settings in /etc/vad/vad.yaml
    sudo vad install --agent      a remote card, settings in /etc/vad/agent.yaml
    vad install --dry-run         what it would do

    Exit code 0: done; 1: installed, and it waits for settings; 2: something cannot be used, and one line says
    what.
    """
    with reported_errors():
        if root is not None:
            for path in write_packaged(root):
                out.print(f"wrote {path}", markup=False, soft_wrap=True)
            return
        _check_machine(dry=dry_run)
        steps = Steps(_say_dry if dry_run else _say, dry=dry_run)
        unit, settings = (AGENT_UNIT, AGENT_SETTINGS) if agent else (HUB_UNIT, HUB_SETTINGS)
        # Before anything is written: settings that cannot be used stop here.
        drop_in = _drop_in(settings, agent=agent) if settings.exists() else None
        if is_packaged():
            _say("is there", "units, user and device rules: they came with the package")
        else:
            _write_files(steps)
        if drop_in is not None:
            name, text = drop_in
            steps.write(UNITS / f"{unit}.d" / name, text)
        steps.run("systemctl", "daemon-reload")
        steps.run("systemctl", "enable", "--quiet", unit)
        if drop_in is None:
            _say("waits", f"for {settings}: " + (_AGENT_NEXT if agent else "sudo vad setup writes it"))
            raise typer.Exit(1)
        if start:
            steps.run("systemctl", "restart", unit)
            if not dry_run:
                state = answer_of(("systemctl", "show", unit, "--property=ActiveState,StatusText", "--value"))
                _say("runs", f"{unit}: {' - '.join(filter(None, state.splitlines()))}")
        out.print(f"Follow it with: journalctl -fu {unit.removesuffix('.service')}", markup=False)


_AGENT_NEXT = (
    "write it (example: /usr/share/doc/vad/examples/agent.yaml, or config/agent.yaml), and copy the folder "
    "of `vad pki issue agent` to /var/lib/vad-agent/credentials"
)


def uninstall(
    purge: Annotated[
        bool, typer.Option("--purge", help="Settings, map, devices, recordings and certificates, too.")
    ] = False,
    dry_run: DryOption = False,
) -> None:
    """Take the services away that `vad install` made; settings and what was learned stay, unless --purge.

    Stops and disables vad.service and vad-agent.service. Files that somebody else wrote or changed the first
    line of stay. The Debian package goes with: sudo apt remove vad (or purge).

    Exit code 0: done; 2: something cannot be used (one line says what).
    """
    with reported_errors():
        if is_packaged():
            raise VadError(
                "this vad came as a Debian package",
                remedy=f"sudo apt {'purge' if purge else 'remove'} vad takes all of it away",
            )
        _check_machine(dry=dry_run)
        steps = Steps(_say_dry if dry_run else _say, dry=dry_run)
        for unit in (HUB_UNIT, AGENT_UNIT):
            if (UNITS / unit).exists():
                steps.run("systemctl", "disable", "--now", "--quiet", unit, may_fail=True)
            for file in sorted((UNITS / f"{unit}.d").glob("*.conf")):
                steps.remove(file)
            if not dry_run and (UNITS / f"{unit}.d").is_dir() and not any((UNITS / f"{unit}.d").iterdir()):
                (UNITS / f"{unit}.d").rmdir()
        for shipped in FILES:
            steps.remove(Path("/") / shipped.local)
        link = Path("/usr/local/bin/vad")
        if link.is_symlink() and link.resolve() == _program():
            steps.remove_tree(link)
        steps.run("systemctl", "daemon-reload", may_fail=True)
        if purge:
            for folder in ("/etc/vad", "/var/lib/vad", "/var/lib/vad-agent", "/var/lib/private/vad-agent"):
                steps.remove_tree(Path(folder))
            steps.run("userdel", "vad", may_fail=True)
        else:
            _say(
                "stays", "/etc/vad and /var/lib/vad: settings and what was learned (--purge takes them, too)"
            )


def _check_machine(*, dry: bool) -> None:
    """VadError where services cannot be installed from here."""
    if not Path("/run/systemd/system").is_dir() and not dry:
        raise VadError(
            "this machine was not started by systemd",
            remedy="Start `vad run` by whatever starts services here",
        )
    if os.geteuid() != 0 and not dry:
        raise VadError(
            "only root may do that", remedy="sudo vad install, or --dry-run to see what it would do"
        )
    program = _program()
    if not is_packaged() and str(program).startswith(_PRIVATE):
        raise VadError(
            "a service cannot see this vad: folders of people are hidden from it",
            where=str(program),
            remedy="Install it in /opt: python3 -m venv /opt/vad && /opt/vad/bin/pip install vad",
        )


def _program() -> Path:
    """The program that runs here, as a service starts it: beside its Python."""
    return Path(sys.executable).absolute().with_name("vad")


def _write_files(steps: Steps) -> None:
    program = _program()
    changed = {file: steps.write(Path("/") / file.local, file.local_text(program)) for file in FILES}

    def applied(file: ServiceFile, *commands: tuple[str, ...]) -> None:
        if changed[file]:
            for command in commands:
                steps.run(*command)

    steps.link(Path("/usr/local/bin/vad"), program)
    applied(USERS, ("systemd-sysusers", f"/{USERS.local}"))
    applied(FOLDERS, ("systemd-tmpfiles", "--create", f"/{FOLDERS.local}"))
    if Path("/run/udev/control").exists():
        steps.run("udevadm", "control", "--reload", may_fail=True)
        steps.run("udevadm", "trigger", "--action=change", "--subsystem-match=video4linux", may_fail=True)
        steps.run("udevadm", "trigger", "--action=change", "--subsystem-match=tty", may_fail=True)


def _drop_in(settings: Path, *, agent: bool) -> tuple[str, str]:
    """Name and text of the drop-in; VadError where the settings cannot be used."""
    from vad.daemon.confinement import DROP_IN, agent_drop_in, hub_drop_in

    if agent:
        plain = parse_yaml(read_text(settings), where=str(settings))
        plain.setdefault("id", "agent")
        return DROP_IN, agent_drop_in(agent_settings(plain, where=str(settings)))
    from vad.daemon.checks import check_files

    loaded = load_settings(settings)
    check_files(loaded, settings)
    return DROP_IN, hub_drop_in(loaded)


def _say(word: str, what: str) -> None:
    out.print(f"{word:<{_WORD}}{what}", markup=False, highlight=False, soft_wrap=True)


def _say_dry(word: str, what: str) -> None:
    _say(f"would {_DRY[word]} " if word in _DRY else word, what)
