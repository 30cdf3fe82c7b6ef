"""The PKI folder: private, whole after a crash, and clear about what is wrong with it."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import pytest

from vad.errors import VadError
from vad.pki.certificates import days_left, utc_now
from vad.pki.credentials import load_credentials, write_credentials
from vad.pki.files import write_private
from vad.pki.folder import PkiFolder

NOW = utc_now()


@pytest.fixture
def pki(tmp_path: Path) -> PkiFolder:
    folder = PkiFolder(tmp_path / "state" / "pki")
    folder.init("home", ["hub.local", "127.0.0.1"], NOW)
    return folder


def modes(folder: Path) -> set[int]:
    return {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}


def test_everything_is_for_its_owner_alone(pki: PkiFolder, tmp_path: Path) -> None:
    os.umask(os.umask(0))  # whatever the umask is
    out = tmp_path / "tablet"
    issued = pki.issue("viewer", "tablet", 10, NOW)
    write_credentials(out, issued, pki.authority_certificate(), "tls/hub.local:7448")
    for folder in (pki.path, out):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert modes(folder) == {0o600}
    assert load_credentials(out).certificate.read_bytes() == issued.chain
    assert 'endpoints: ["tls/hub.local:7448"]' in (out / "zenoh.json5").read_text()


def test_a_clients_key_is_not_kept(pki: PkiFolder) -> None:
    issued = pki.issue("viewer", "tablet", 10, NOW)
    secret = issued.key.split(b"\n")[1]
    assert all(secret not in path.read_bytes() for path in pki.path.iterdir())


def test_init_twice_destroys_nothing(pki: PkiFolder) -> None:
    before = pki.authority_certificate()
    with pytest.raises(VadError, match="there is an authority already"):
        pki.init("home", [], NOW)
    assert pki.authority_certificate() == before
    (pki.path / "certificates.json").unlink()
    with pytest.raises(VadError, match="not empty"):
        pki.init("home", [], NOW)


def test_a_name_has_one_holder(pki: PkiFolder) -> None:
    pki.issue("agent", "kitchen", 10, NOW)
    with pytest.raises(VadError, match="in force with this name"):
        pki.issue("viewer", "kitchen", 10, NOW)
    pki.revoke("kitchen", NOW)
    pki.issue("viewer", "kitchen", 10, NOW)
    with pytest.raises(VadError, match="not a name"):
        pki.issue("viewer", "../kitchen", 10, NOW)


def test_rotation_keeps_the_old_one_until_it_is_revoked(pki: PkiFolder) -> None:
    first = pki.issue("agent", "kitchen", 10, NOW)
    old, second = pki.rotate("kitchen", 20, NOW, revoke_old=False)
    assert old.common_name == first.common_name
    in_force = {c.common_name for c in pki.register().in_force(NOW)}
    assert in_force == {first.common_name, second.common_name}
    pki.revoke(first.common_name, NOW)
    assert [c.common_name for c in pki.register().in_force(NOW)] == [second.common_name]
    _, third = pki.rotate("kitchen", 20, NOW, revoke_old=True)
    assert [c.common_name for c in pki.register().in_force(NOW)] == [third.common_name]
    assert all(c.role == "agent" for c in pki.register().certificates)


def test_revoking_nobody_says_who_there_is(pki: PkiFolder) -> None:
    pki.issue("viewer", "tablet", 10, NOW)
    with pytest.raises(VadError, match="In force: tablet"):
        pki.revoke("tabelt", NOW)


def test_the_hubs_certificate_is_replaced_with_its_key(pki: PkiFolder) -> None:
    before = pki.hub_file.read_bytes()
    end = pki.rotate_hub(["new.local"], NOW + timedelta(days=100))
    assert pki.hub_file.read_bytes() != before
    assert pki.hub_addresses() == ("new.local",)
    assert days_left(end, NOW) > 400
    assert modes(pki.path) == {0o600}


def test_without_the_authoritys_key_it_lets_in_but_issues_nothing(pki: PkiFolder) -> None:
    pki.issue("viewer", "tablet", 10, NOW)
    (pki.path / "ca.key").unlink()
    assert len(pki.hub_files().register.in_force(NOW)) == 1
    for attempt in (
        lambda: pki.issue("viewer", "phone", 10, NOW),
        lambda: pki.rotate("tablet", 10, NOW, revoke_old=True),
        lambda: pki.rotate_hub(["h"], NOW),
    ):
        with pytest.raises(VadError, match="private key is not here"):
            attempt()
    assert len(pki.register().in_force(NOW)) == 1, "nothing was revoked on the way"
    pki.revoke("tablet", NOW)


def test_an_open_private_file_is_not_used(pki: PkiFolder, tmp_path: Path) -> None:
    issued = pki.issue("viewer", "tablet", 10, NOW)
    write_credentials(tmp_path / "tablet", issued, pki.authority_certificate(), "tls/h:1")
    (tmp_path / "tablet" / "client.key").chmod(0o644)
    with pytest.raises(VadError, match="others may read this private file") as caught:
        load_credentials(tmp_path / "tablet")
    assert "chmod 600" in caught.value.remedy
    pki.hub_file.chmod(0o640)
    with pytest.raises(VadError, match="others may read"):
        pki.hub_files()


def test_a_damaged_or_missing_list_is_said(pki: PkiFolder, tmp_path: Path) -> None:
    for damage in (b"", b"{", b'{"hub": 1}', b"\xff", b'{"hub":"a","x":1}', b"[" * 5000):
        pki.register_file.write_bytes(damage)
        with pytest.raises(VadError, match="damaged"):
            pki.register()
    pki.register_file.unlink()
    with pytest.raises(VadError, match="vad pki init"):
        pki.register()
    with pytest.raises(VadError, match="vad pki init"):
        PkiFolder(tmp_path / "nowhere").hub_files()
    with pytest.raises(VadError, match="no such file"):
        load_credentials(tmp_path)


def test_two_at_once_lose_nothing(pki: PkiFolder) -> None:
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda i: pki.issue("viewer", f"n{i}", 10, NOW), range(16)))
    assert len(pki.register().in_force(NOW)) == 16


@pytest.mark.slow
def test_killed_while_writing_leaves_the_old_or_the_new(pki: PkiFolder) -> None:
    program = (
        "import sys\nfrom pathlib import Path\nfrom vad.pki.files import write_private\n"
        "print('up', flush=True)\n"
        "while True:\n"
        "    for content in (b'a' * 200_000, b'b' * 300_000):\n"
        "        write_private(Path(sys.argv[1]), content)\n"
    )
    path = pki.path / "file"
    write_private(path, b"a" * 200_000)
    for _ in range(5):
        with subprocess.Popen(
            [sys.executable, "-c", program, str(path)],
            stdout=subprocess.PIPE,
            cwd=Path(__file__).parents[2],
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"up\n"
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(0.1)
            process.kill()
        assert path.read_bytes() in (b"a" * 200_000, b"b" * 300_000)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root makes files for others")
def test_what_root_makes_in_the_daemons_folder_is_the_daemons(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    os.chown(state, 4321, 4322)
    pki = PkiFolder(state / "pki")
    pki.init("home", ["h"], NOW)
    pki.issue("viewer", "tablet", 10, NOW)
    pki.rotate_hub(["h"], NOW)
    for path in (pki.path, *pki.path.iterdir()):
        assert (path.stat().st_uid, path.stat().st_gid) == (4321, 4322), path
