"""`vad install`, `vad uninstall`: what is written where, what stays; nothing of this machine is touched."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vad.commands.app import app
from vad.commands.service_files import FILES, MARK, is_packaged, shipped_folder
from vad.commands.system_steps import Steps
from vad.errors import VadError


def invoke(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(arguments))
    return result.exit_code, result.output


class Told:
    """Hears what steps are done."""

    def __init__(self, *, dry: bool = False) -> None:
        self.said: list[tuple[str, str]] = []
        self.steps = Steps(lambda word, what: self.said.append((word, what)), dry=dry)

    @property
    def words(self) -> list[str]:
        return [word for word, _ in self.said]


def test_a_root_folder_gets_what_a_package_has(tmp_path: Path) -> None:
    code, said = invoke("install", "--root", str(tmp_path))
    assert code == 0
    written = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert written == {file.packaged for file in FILES}
    assert said.count("wrote") == len(FILES)
    unit = (tmp_path / "usr/lib/systemd/system/vad.service").read_text()
    assert unit == (shipped_folder() / "vad.service").read_text()
    assert is_packaged(tmp_path)
    assert not is_packaged(tmp_path / "etc")


def test_a_vad_elsewhere_is_what_the_unit_starts() -> None:
    (unit,) = [file for file in FILES if file.name == "vad.service"]
    text = unit.local_text(Path("/opt/vad/bin/vad"))
    assert text.startswith(MARK)
    assert "ExecStart=/opt/vad/bin/vad run --config /etc/vad/vad.yaml" in text
    assert "ExecReload=/opt/vad/bin/vad check-config" in text
    assert "/usr/bin/vad" not in text


def test_a_dry_run_says_everything_and_does_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/opt/vad/bin/python")  # wherever these tests run
    if is_packaged():
        pytest.skip("vad is installed here as a package")
    here = {file.local: (Path("/") / file.local).exists() for file in FILES}
    code, said = invoke("install", "--dry-run")
    assert code == (0 if Path("/etc/vad/vad.yaml").exists() else 1), said
    for file in FILES:
        assert f"/{file.local}" in said
    assert "would run     systemctl enable --quiet vad.service" in said
    assert here == {file.local: (Path("/") / file.local).exists() for file in FILES}


def test_without_systemd_or_root_it_says_so() -> None:
    if Path("/run/systemd/system").is_dir():
        pytest.skip("systemd runs here, and the command would install")
    code, said = invoke("install")
    assert code == 2
    assert "this machine was not started by systemd" in said
    assert invoke("uninstall")[0] == 2


def test_writing_twice_changes_nothing_the_second_time(tmp_path: Path) -> None:
    told, path = Told(), tmp_path / "a" / "unit"
    assert told.steps.write(path, MARK + "one\n")
    assert not told.steps.write(path, MARK + "one\n")
    assert told.steps.write(path, MARK + "two\n")
    assert told.words == ["wrote", "is there", "changed"]
    assert path.read_text() == MARK + "two\n"
    assert list(path.parent.iterdir()) == [path]


def test_what_somebody_else_wrote_stays(tmp_path: Path) -> None:
    told, path = Told(), tmp_path / "unit"
    path.write_text("[Service]\n# my own\n")
    assert not told.steps.write(path, MARK + "ours\n")
    assert not told.steps.remove(path)
    assert path.read_text() == "[Service]\n# my own\n"
    assert all(word.startswith("left as it is") for word in told.words)


def test_what_we_wrote_goes_and_a_dry_run_only_says_it(tmp_path: Path) -> None:
    path, folder = tmp_path / "unit", tmp_path / "state"
    Told().steps.write(path, MARK)
    (folder / "sessions").mkdir(parents=True)
    for dry in (True, False):
        told = Told(dry=dry)
        assert told.steps.remove(path)
        told.steps.remove_tree(folder)
        assert told.words[:2] == ["removed", "removed"]
        assert path.exists() == folder.exists() == dry
    assert not Told().steps.remove(path), "it is gone"


def test_a_program_that_fails_is_an_error_with_what_it_said(tmp_path: Path) -> None:
    with pytest.raises(VadError, match="nonsense"):
        Told().steps.run("ls", str(tmp_path / "nonsense"))
    Told().steps.run("ls", str(tmp_path / "nonsense"), may_fail=True)
    with pytest.raises(VadError, match="cannot be run"):
        Told().steps.run(str(tmp_path / "no-such-program"))
    Told().steps.run(str(tmp_path / "no-such-program"), may_fail=True)


def test_a_place_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(VadError, match="cannot be written"):
        Told().steps.write(tmp_path / "file" / "unit", MARK)


def test_the_daemon_does_not_load_what_draws() -> None:
    """matplotlib takes a third of a second at every start, and builds a list of fonts at the first."""
    program = (
        "import sys; import vad.commands.app, vad.daemon.app; "
        "sys.exit(any(m.partition('.')[0] == 'matplotlib' for m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False, timeout=50)
    assert done.returncode == 0, done.stderr.decode()
