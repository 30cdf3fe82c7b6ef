"""Whether the service's user may use a file: root, who asks, may everything and learns nothing by trying."""

from __future__ import annotations

import grp
import os
import pwd
import stat
from dataclasses import dataclass
from pathlib import Path

from vad.commands.doctor.unit import unit_values

USER = "vad"
_ANYBODY = {"r": stat.S_IROTH, "w": stat.S_IWOTH, "x": stat.S_IXOTH}


@dataclass(frozen=True, slots=True)
class Identity:
    """A user and all its groups, by number."""

    name: str
    uid: int
    groups: frozenset[int]

    def refusal(self, path: Path, wanted: str) -> str:
        """Why this user may not use `path` as `wanted` (of `rwx`); empty where it may, or nothing is there.

        What access control lists add is not seen.
        """
        path = path.resolve()
        for folder in reversed(path.parents):
            if folder.exists() and not self._may(folder.stat(), "x"):
                return f"{self.name} may not enter {folder}"
        if path.exists() and not self._may(path.stat(), wanted):
            how = {"r": "read", "w": "write", "rw": "read and write"}.get(wanted, wanted)
            return f"{self.name} may not {how} {path}"
        return ""

    def remedy(self, path: Path) -> str:
        """How this user comes to use it: by the group that owns it."""
        path = path.resolve()
        barred = (one for one in (*reversed(path.parents), path) if one.exists())
        owner = next((one for one in barred if not self._may(one.stat(), "x" if one.is_dir() else "r")), path)
        if not owner.exists():
            return ""
        about = owner.stat()
        bits = stat.S_IXGRP if owner.is_dir() else stat.S_IRGRP
        if about.st_gid not in (0, *self.groups) and about.st_mode & bits:
            return f"sudo usermod -aG {group_name(about.st_gid)} {self.name}, then restart vad"
        if owner.is_dir():
            return f"sudo chmod o+x {owner}"
        return f"sudo chgrp {self.name} {owner} && sudo chmod g+rw {owner}"

    def _may(self, about: os.stat_result, wanted: str) -> bool:
        if self.uid == 0:
            return True
        shift = 6 if about.st_uid == self.uid else 3 if about.st_gid in self.groups else 0
        return all(about.st_mode & (_ANYBODY[letter] << shift) for letter in wanted)


def group_name(gid: int) -> str:
    """A group's name, or its number where it has none."""
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def service_identity(root: Path) -> Identity | None:
    """As whom the service runs; None unless root asks and there is such a user."""
    if os.geteuid() != 0:
        return None
    try:
        user = pwd.getpwnam((unit_values(root, "User") or [USER])[-1])
    except KeyError:
        return None
    groups = {user.pw_gid, *os.getgrouplist(user.pw_name, user.pw_gid)}
    for name in " ".join(unit_values(root, "SupplementaryGroups")).split():
        try:
            groups.add(grp.getgrnam(name).gr_gid)
        except KeyError:
            continue
    return Identity(user.pw_name, user.pw_uid, frozenset(groups))
