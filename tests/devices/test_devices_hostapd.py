"""hostapd's messages, without I/O."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.devices.hostapd import (
    OtherEvent,
    Reply,
    Station,
    StationChange,
    Terminating,
    parse_message,
    parse_station,
    sta_next,
)
from vad.errors import ProtocolError
from vad.mac import mac_to_text

MAC = "02:00:00:aa:bb:cc"

macs = st.integers(0, (1 << 48) - 1).map(mac_to_text)


@pytest.mark.parametrize(
    ("datagram", "message"),
    [
        (b"<3>AP-STA-CONNECTED 02:00:00:aa:bb:cc", StationChange("joined", MAC)),
        (b"<3>AP-STA-CONNECTED 02:00:00:AA:BB:CC keyid=guest auth_alg=open\n", StationChange("joined", MAC)),
        (b"<2>AP-STA-DISCONNECTED 02:00:00:aa:bb:cc reason=8", StationChange("left", MAC)),
        (b"IFNAME=wlan0 <3>AP-STA-CONNECTED 02:00:00:aa:bb:cc", StationChange("joined", MAC)),
        (b"<3>CTRL-EVENT-TERMINATING ", Terminating()),
        (b"<3>AP-STA-POSSIBLE-PSK-MISMATCH 02:00:00:aa:bb:cc", OtherEvent()),
        (b"<3>AP-STA-CONNECTED-NOT-YET 02:00:00:aa:bb:cc", OtherEvent()),
        (b"<3>AP-ENABLED ", OtherEvent()),
        (b"PONG\n", Reply("PONG")),
        (b"", Reply("")),
        (b"AP-STA-CONNECTED 02:00:00:aa:bb:cc", Reply("AP-STA-CONNECTED 02:00:00:aa:bb:cc")),
    ],
)
def test_messages(datagram: bytes, message: object) -> None:
    assert parse_message(datagram) == message


@given(macs, st.text(max_size=30))
def test_words_may_be_appended(mac: str, words: str) -> None:
    assert parse_message(f"<3>AP-STA-CONNECTED {mac} {words}".encode()) == StationChange("joined", mac)


@given(st.binary(max_size=80), st.sampled_from([b"", b"<3>", b"<3>AP-STA-CONNECTED ", b"IFNAME=a "]))
def test_any_datagram_gives_a_message_or_a_typed_error(data: bytes, head: bytes) -> None:
    try:
        message = parse_message(head + data)
    except ProtocolError:
        return
    if isinstance(message, Reply):
        try:
            parse_station(message)
        except ProtocolError:
            return


@pytest.mark.parametrize("datagram", [b"<3>AP-STA-CONNECTED", b"<3>AP-STA-DISCONNECTED 02:00:00"])
def test_an_event_without_a_whole_address(datagram: bytes) -> None:
    with pytest.raises(ProtocolError, match="no station address"):
        parse_message(datagram)


def test_entries_of_the_list() -> None:
    entry = "02:00:00:AA:BB:CC\nflags=[AUTH][ASSOC]%s\naid=1\n"
    assert parse_station(Reply(entry % "[AUTHORIZED][WMM]")) == Station(MAC, authorized=True)
    assert parse_station(Reply(entry % "")) == Station(MAC, authorized=False)
    assert parse_station(Reply(f"{MAC}\naid=1")) == Station(MAC, authorized=True)
    assert parse_station(Reply("")) is None
    assert sta_next(MAC) == b"STA-NEXT 02:00:00:aa:bb:cc"
    with pytest.raises(ProtocolError):
        parse_station(Reply("FAIL"))
