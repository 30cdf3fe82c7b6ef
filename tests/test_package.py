"""The Debian package in a bare Debian 12: installs without any network, keeps settings, purges clean."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from vad.sim.render import Renderer
from vad.sim.scenario import make_home
from vad.vision.people import PoseNetwork

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]

ROOT = Path(__file__).resolve().parents[1]
NEEDED = ("mmdebstrap", "chroot", "mount")
DEPENDS = "python3.11,libstdc++6,zlib1g,libusb-1.0-0,systemd,udev"
ARM64 = Path("/proc/sys/fs/binfmt_misc/qemu-aarch64")
MOST_MB = 200
"""What a hub has to fetch."""
IGNORED = ("var/log", "var/lib/dpkg", "var/cache", "proc", "run", "root", "tmp", "dev", "etc/.pwd.lock")
USERS = ("etc/passwd-", "etc/group-", "etc/shadow-", "etc/gshadow-", "etc/subuid-", "etc/subgid-")


class Debian:
    """A bare Debian 12 in a folder; no network, no compiler."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def run(self, *command: str, code: int = 0) -> str:
        """What a program in it says."""
        done = subprocess.run(
            ["unshare", "--net", "chroot", self.root, "env", "-i", "PATH=/usr/sbin:/usr/bin", *command],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout + done.stderr

    def files(self) -> set[str]:
        """Every path, with whose it is and who may what; dpkg's own books, logs and caches left out."""
        found = set()
        for folder, folders, names in os.walk(self.root):
            inside = Path(folder).relative_to(self.root)
            folders[:] = [name for name in folders if not str(inside / name).startswith(IGNORED)]
            for name in [*folders, *names]:
                path = inside / name
                if str(path) in USERS or str(path).startswith(IGNORED) or path.suffix == ".pyc":
                    continue
                about = (self.root / path).lstat()
                found.add(f"{path} {about.st_uid}:{about.st_gid} {about.st_mode:o}")
        return found


@contextmanager
def debian_in(root: Path, arch: str) -> Iterator[Debian]:
    """One of this architecture, with what the package depends on."""
    if missing := [tool for tool in NEEDED if shutil.which(tool) is None]:
        pytest.skip(f"no {', '.join(missing)}: apt-get install mmdebstrap mount")
    if os.geteuid() != 0:
        pytest.skip("a root folder of Debian's needs root")
    made = subprocess.run(
        ["mmdebstrap", "--quiet", "--variant=minbase", "--mode=root", "--skip=check/empty",
         f"--architectures={arch}", f"--include={DEPENDS}", '--aptopt=APT::Install-Recommends "false"',
         "--dpkgopt=force-unsafe-io", "--dpkgopt=path-exclude=/usr/share/man/*", "bookworm", str(root)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr[-2000:]
    subprocess.run(["mount", "--bind", "/proc", root / "proc"], check=True)
    try:
        yield Debian(root)
    finally:
        subprocess.run(["umount", root / "proc"], check=True)


@pytest.fixture(scope="module")
def debian(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Debian]:
    """One as here."""
    assert package.is_file()
    with debian_in(tmp_path_factory.mktemp("debian") / "root", "amd64") as here:
        yield here


def test_it_is_not_too_large_and_carries_no_path_of_the_builder(package: Path, tmp_path: Path) -> None:
    assert package.stat().st_size < MOST_MB * 1_000_000
    subprocess.run(["dpkg-deb", "--extract", package, tmp_path], check=True)
    told = subprocess.run(
        ["grep", "-rlI", "--", str(ROOT), tmp_path], capture_output=True, text=True, check=False
    )
    assert told.stdout == ""
    programs = {file.name for file in (tmp_path / "usr" / "lib" / "vad" / "bin").iterdir()}
    assert programs == {"python", "python3", "python3.11", "vad"}


def test_it_installs_upgrades_and_leaves_nothing(package: Path, debian: Debian, tmp_path: Path) -> None:
    before = debian.files()
    shutil.copy(package, debian.root / "root" / "vad.deb")
    said = debian.run("dpkg", "-i", "/root/vad.deb")
    assert "Next: sudo vad setup" in said
    assert set(debian.run("id", "-nG", "vad").split()) == {"vad", "dialout", "netdev", "video"}
    for unit in ("vad.service", "vad-agent.service"):
        assert (debian.root / "etc/systemd/system/multi-user.target.wants" / unit).is_symlink()

    # It runs, from its own environment: everything it imports is there.
    assert debian.run("vad", "--version").strip()
    modules = (
        "import vad.daemon.app, vad.agent.node, vad.web.server, vad.homeassistant.broker, vad.report.floor"
    )
    debian.run("/usr/lib/vad/bin/python", "-I", "-c", modules)
    assert "cannot be read (No such file or directory)" in debian.run("vad", "check-config", code=2)

    # The example is a usable file; what is written in /etc/vad is the service's group's.
    settings = debian.root / "etc/vad/vad.yaml"
    debian.run(
        "sh", "-c", "cp /usr/share/doc/vad/examples/vad.yaml /etc/vad/ && echo '# mine' >> /etc/vad/vad.yaml"
    )
    assert "the settings are usable" in debian.run("vad", "check-config")
    assert debian.run("stat", "-c", "%G", "/etc/vad/vad.yaml").strip() == "vad"
    debian.run("sh", "-c", "echo kept > /var/lib/vad/vad.sqlite")

    # A later version keeps them, and an administrator's will.
    mine = settings.read_bytes()
    debian.run("systemctl", "disable", "vad-agent.service")
    debian.run("dpkg", "-i", f"/root/{later(package, debian.root / 'root', tmp_path)}")
    assert debian.run("dpkg-query", "-W", "-f", "${Version}", "vad").endswith("+later")
    assert settings.read_bytes() == mine
    wants = debian.root / "etc/systemd/system/multi-user.target.wants"
    assert (wants / "vad.service").is_symlink()
    assert not (wants / "vad-agent.service").is_symlink()

    debian.run("dpkg", "-r", "vad")
    assert settings.read_bytes() == mine
    assert (debian.root / "var/lib/vad/vad.sqlite").read_text() == "kept\n"
    assert not (debian.root / "usr/lib/vad").exists()
    debian.run("dpkg", "-P", "vad")
    after = debian.files()
    assert {line for line in after - before if "/etc/netdev" not in line} == set()
    assert before - after == set()
    debian.run("id", "vad", code=1)


def later(package: Path, folder: Path, tmp_path: Path) -> str:
    """The same package with a later version; its name in `folder`."""
    tree = tmp_path / "tree"
    subprocess.run(["dpkg-deb", "--raw-extract", package, tree], check=True)
    control = tree / "DEBIAN" / "control"
    control.write_text(
        "\n".join(
            f"{line}+later" if line.startswith("Version:") else line
            for line in control.read_text().splitlines()
        )
        + "\n"
    )
    build = ["dpkg-deb", "--root-owner-group", "-Zzstd", "-z1", "--build", tree, folder / "later.deb"]
    subprocess.run(build, check=True, capture_output=True)
    return "later.deb"


LOOK = """
import json, platform, sys
import cv2, msgspec, serial, usb, yaml, zenoh
from vad.vision.people import PoseNetwork
people = PoseNetwork().infer(cv2.imread(sys.argv[1]))
print(json.dumps([platform.machine(), [person.keypoints[:, :2].tolist() for person in people]]))
"""


def test_the_arm64_package_runs_and_sees_the_same(tmp_path: Path) -> None:
    """Emulated; what a Raspberry Pi would install."""
    if not ARM64.exists():
        pytest.skip("no arm64 emulation: apt-get install qemu-user-static binfmt-support")
    build = [str(ROOT / "tools" / "deb" / "build"), "--arch", "arm64", "--out", str(tmp_path)]
    subprocess.run(build, check=True, capture_output=True)
    picture = tmp_path / "people.png"
    home = make_home(1)
    cv2.imwrite(str(picture), Renderer(home).frame(home.walks[0].start_s + 6.0))
    with debian_in(tmp_path / "root", "arm64") as there:
        for file in (picture, next(tmp_path.glob("vad_*_arm64.deb"))):
            shutil.copy(file, there.root / "root")
        there.run("sh", "-c", "dpkg -i /root/vad_*_arm64.deb")
        assert there.run("vad", "--version").strip()
        there.run("sh", "-c", "cp /usr/share/doc/vad/examples/vad.yaml /etc/vad/")
        assert "the settings are usable" in there.run("vad", "check-config")
        said = there.run("/usr/lib/vad/bin/python", "-I", "-c", LOOK, "/root/people.png")
        machine, found = json.loads(said.splitlines()[0])
    assert machine == "aarch64"
    here = [person.keypoints[:, :2].tolist() for person in PoseNetwork().infer(cv2.imread(str(picture)))]
    assert len(here) == 1
    np.testing.assert_allclose(found, here, atol=0.5)
