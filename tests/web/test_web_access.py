"""Who may change something: token files, cookies, tries; which addresses are the hub's own."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.errors import ConfigError
from vad.web.access import (
    LOGIN_S,
    MIN_CHARACTERS,
    TRIES,
    TRIES_S,
    TokenFile,
    Tries,
    check_address,
    cookie_holds,
    make_cookie,
    new_token,
    same_token,
    write_token,
)

NOW_S = 1_780_000_000.0
TOKEN = b"a-token-that-nobody-guesses-0123456789"


def test_a_written_token_is_its_owners_alone_and_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "web.token"
    first = write_token(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert TokenFile(path).read().decode() == first
    second = write_token(path)
    assert second != first
    assert TokenFile(path).read().decode() == second
    assert [p.name for p in tmp_path.iterdir()] == ["web.token"], "no draft is left"


def test_the_group_of_a_folder_that_hands_it_on_reads_the_token(tmp_path: Path) -> None:
    tmp_path.chmod(0o2755)
    write_token(tmp_path / "web.token")
    assert (tmp_path / "web.token").stat().st_mode & 0o777 == 0o640
    TokenFile(tmp_path / "web.token").read()


@pytest.mark.parametrize("mode", [0o644, 0o604, 0o602, 0o660, 0o666])
def test_a_token_that_others_can_read_or_change_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "web.token"
    write_token(path)
    path.chmod(mode)
    with pytest.raises(ConfigError, match="chmod 600"):
        TokenFile(path).read()


@pytest.mark.parametrize(
    "text", ["", "short", "x" * (MIN_CHARACTERS - 1), "two words " * 10, "ä" * 40, "x" * 5000]
)
def test_what_is_no_token_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "web.token"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match="vad web token"):
        TokenFile(path).read()


def test_a_token_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        TokenFile(tmp_path / "none").read()
    with pytest.raises(ConfigError, match="cannot be written"):
        write_token(tmp_path / "none" / "token")


def test_a_cookie_holds_for_its_token_and_time() -> None:
    cookie = make_cookie(TOKEN, NOW_S)
    assert cookie_holds(TOKEN, cookie, NOW_S)
    assert cookie_holds(TOKEN, cookie, NOW_S + LOGIN_S - 1)
    assert not cookie_holds(TOKEN, cookie, NOW_S + LOGIN_S)
    assert not cookie_holds(new_token().encode(), cookie, NOW_S), "a new token ends every log-in"


@given(st.data())
def test_no_other_cookie_holds(data: st.DataObject) -> None:
    cookie = make_cookie(TOKEN, NOW_S)
    at = data.draw(st.integers(0, len(cookie)))
    other = cookie[:at] + data.draw(st.text(max_size=8)) + cookie[data.draw(st.integers(at, len(cookie))) :]
    assert cookie_holds(TOKEN, other, NOW_S) == (other == cookie)


@given(st.text())
def test_only_the_token_is_the_token(given_token: str) -> None:
    assert same_token(TOKEN, given_token) == (given_token.strip() == TOKEN.decode())
    assert not cookie_holds(TOKEN, given_token, NOW_S)


def test_guessing_is_slow() -> None:
    tries = Tries()
    for i in range(TRIES):
        assert tries.wait_s(100.0 + i) == 0
        tries.wrong(100.0 + i)
    assert tries.wait_s(100.0 + TRIES) == pytest.approx(TRIES_S - TRIES)
    assert tries.wait_s(100.0 + TRIES_S) == 0


@pytest.mark.parametrize("address", ["127.0.0.1", "127.0.0.2", "::1"])
def test_addresses_of_the_hub_itself(address: str) -> None:
    check_address(address, where="$.web.address")


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.168.1.10", "localhost", "", "fe80::1"])
def test_an_address_that_others_reach_is_refused_with_the_way_to_go(address: str) -> None:
    with pytest.raises(ConfigError, match=r"reverse proxy.*Home Assistant") as refused:
        check_address(address, where="$.web.address")
    assert "$.web.address" in str(refused.value)
