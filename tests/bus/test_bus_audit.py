"""zenoh's log lines as they were seen: attempts are told, working out of permissions is not."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.bus.audit import AuditReader, Denied, Other, Refused

pytestmark = pytest.mark.timeout(600)
"""Much work for the processor: a busy machine takes many times as long as an idle one."""

ZID = "dcf3a494386481c1c412ab9a73869acc"
OTHER = "c2af4d36de5f47fba53c6f2e0a8f1b90"
WHERE = (
    "2026-11-22T03:39:08.540126Z TRACE  rx-1 ThreadId(09) demux{zid=a3cd src=south:0:client/dcf3a494:2}: "
    "zenoh::net::routing::interceptor::access_control: "
)
WHO = f"{ZID} on Interface(lo)+CertCommonName(viewer.tablet.1a2b)+Transport(Tls)+{ZID}"
TLS = "2026-11-22T03:39:10.962758Z  WARN acc-0 ThreadId(05) zenoh_link_tls::unicast: "


def read(*lines: str) -> list[object]:
    reader = AuditReader()
    return [found for line in lines if (found := reader.read(WHERE + line + "\n")) is not None]


def test_an_attempt_is_told() -> None:
    line = f"{WHO} is unauthorized to Put (ingress) on vad/home/devices/x"
    assert read(line) == [Denied(ZID, "viewer.tablet.1a2b", "Put", "vad/home/devices/x")]


def test_a_cached_attempt_is_told_without_a_name() -> None:
    what = "Declare Subscriber (ingress) on vad/home/agents/a1/csi"
    assert read(f"Using cached result: {ZID} is unauthorized to {what}") == [
        Denied(ZID, "", "Declare Subscriber", "vad/home/agents/a1/csi")
    ]


def test_a_cached_attempt_is_named_once_any_line_has_told_who_that_is() -> None:
    found = read(
        "ACL (ingress): caching permissions for `vad/home` ...",
        f"{WHO} is authorized to Query (ingress) on vad/home",
        f"Using cached result: {ZID} is unauthorized to Put (ingress) on vad/home/x",
        f"Using cached result: {OTHER} is unauthorized to Put (ingress) on access_control: "
        f"{OTHER} on CertCommonName(admin.boss.1)",
        f"Using cached result: {OTHER} is unauthorized to Put (ingress) on vad/home/x",
    )
    names = [denied.common_name for denied in found if isinstance(denied, Denied)]
    assert names == ["viewer.tablet.1a2b", "", ""], "a key tells no names"


def test_what_zenoh_works_out_nobody_attempted() -> None:
    key = "vad/home/events"
    assert (
        read(
            f"ACL (ingress): caching permissions for `{key}` ...",
            f"{WHO} is authorized to Query (ingress) on {key}",
            f"{WHO} is unauthorized to Put (ingress) on {key}",
            f"{WHO} is unauthorized to Declare/Undeclare Queryable (ingress) on {key}",
            f"ACL (egress): caching permissions for `{key}` ...",
            f"{WHO} is unauthorized to Query (egress) on {key}",
        )
        == []
    )


def test_an_attempt_right_after_working_out_another_key_is_told() -> None:
    found = read(
        "ACL (ingress): caching permissions for `vad/home` ...",
        f"{WHO} is unauthorized to Put (ingress) on vad/home",
        f"{WHO} is unauthorized to Put (ingress) on vad/home/agents/a2/csi",
        f"{WHO} is unauthorized to Put (ingress) on vad/home",
    )
    assert [denied.key for denied in found if isinstance(denied, Denied)] == [
        "vad/home/agents/a2/csi",
        "vad/home",
    ]


def test_what_is_allowed_and_what_the_hub_sends_is_nothing() -> None:
    assert read(f"{WHO} is authorized to Put (ingress) on vad/home/x") == []
    assert read(f"{WHO} is unauthorized to Put (egress) on vad/home/agents/a1/csi") == []


@pytest.mark.parametrize(
    ("cause", "reason"),
    [
        ("invalid peer certificate: UnknownIssuer", "another authority, or one that was revoked"),
        ("invalid peer certificate: certificate expired: verification time 1 (UNIX)", "an expired"),
        ("peer sent no certificates", "no certificate"),
        ("received fatal alert: BadCertificate", "does not trust this hub"),
        ("Timeout during TLS handshake", "said nothing"),
        ("something of a later version", "something of a later version"),
    ],
)
def test_why_a_connection_was_refused(cause: str, reason: str) -> None:
    found = AuditReader().read(f"{TLS}{cause}. Hint: increase the system open file limit.")
    assert isinstance(found, Refused)
    assert reason in found.reason


def test_colours_do_not_matter_and_other_warnings_are_kept() -> None:
    line = "\x1b[2m2026-11-22T03:37:56Z\x1b[0m \x1b[33m WARN\x1b[0m zenoh::net: \x1b[2mtrouble"
    assert isinstance(AuditReader().read(line), Other)
    assert AuditReader().read("2026-11-22T03:37:56Z  INFO zenoh::net: all well") is None


@given(st.lists(st.text(max_size=80) | st.sampled_from([WHERE, TLS, WHO]), max_size=8).map("".join))
def test_any_line_is_read(line: str) -> None:
    AuditReader().read(line)
