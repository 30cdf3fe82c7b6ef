"""What zenoh's log tells of attempts that were denied: lines -> values, no I/O.

zenoh 1.10 tells of a denied message only at its finest log level, and when a client first names a key it
works out, and logs, what that client may do there, message kind by message kind: nobody attempted that. It
tells of a refused connection why, but neither from which address nor with which certificate.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

LOG_FILTER = "warn,zenoh::net::routing::interceptor::access_control=trace"
"""What zenoh must be told to log for this."""

MAX_THREADS = 64
MAX_NAMES = 256

_ANSI = re.compile(r"\x1b\[[0-9;]*m")
_THREAD = re.compile(r"\bThreadId\((\d+)\)")
_CACHING = re.compile(r"access_control: ACL \(ingress\): caching permissions for `(?P<key>.*)` \.\.\.$")
_DENIED = re.compile(
    r"access_control: (?P<cached>Using cached result: )?(?P<zid>[0-9a-f]+)"
    r"(?: on [^ ]+)? is unauthorized to (?P<what>[A-Za-z/ ]+) \(ingress\)(?: on (?P<key>.*))?$"
)
_VERDICT = re.compile(
    r"access_control: [0-9a-f]+ on \S+ is (?:un)?authorized to [A-Za-z/ ]+ \(ingress\) on (.*)$"
)
_WHO = re.compile(r"([0-9a-f]+) on \S*CertCommonName\(([^)]*)\)")
_REFUSED = re.compile(r"\bWARN\b.*zenoh_link_tls::\w+: (?P<reason>.*?)(?:\. Hint: .*)?$")

_REASONS = (
    ("UnknownIssuer", "a certificate of another authority, or one that was revoked"),
    ("certificate expired", "an expired certificate"),
    ("not valid yet", "a certificate that is not valid yet: is the clock right?"),
    ("peer sent no certificates", "no certificate"),
    ("extended key usage", "a certificate that is not for clients"),
    ("Timeout during TLS handshake", "a connection that said nothing"),
    ("received fatal alert", "a client that does not trust this hub"),
)
"""What zenoh writes, and what it means here."""


@dataclass(frozen=True, slots=True)
class Denied:
    """A message that an access rule stopped. common_name: empty where only the session's id is told."""

    zid: str
    common_name: str
    what: str
    key: str


@dataclass(frozen=True, slots=True)
class Refused:
    """A connection that was not let in."""

    reason: str


@dataclass(frozen=True, slots=True)
class Other:
    """Another warning of zenoh."""

    text: str


class AuditReader:
    """Follows zenoh's log, line by line."""

    def __init__(self) -> None:
        self._working_out: dict[str, str] = {}  # thread -> the key whose permissions it works out
        self._names: dict[str, str] = {}  # session's id -> its common name, which only some lines tell

    def read(self, line: str) -> Denied | Refused | Other | None:
        """What a line tells; None where it is nothing of this."""
        line = _ANSI.sub("", line.rstrip())
        if "access_control:" in line:
            return self._access(line)
        if found := _REFUSED.search(line):
            reason = found["reason"]
            return Refused(next((told for sign, told in _REASONS if sign in reason), reason[:120]))
        if " WARN " in line or " ERROR " in line:
            return Other(line.split(" ", 1)[-1].strip()[:300])
        return None

    def _access(self, line: str) -> Denied | None:
        found = _THREAD.search(line)
        thread = found[1] if found else ""
        if caching := _CACHING.search(line):
            if len(self._working_out) >= MAX_THREADS:  # a key that looks like a line of the log
                self._working_out.clear()
            self._working_out[thread] = caching["key"]
            return None
        # Matched where the message begins: behind it may stand a key that somebody made up.
        if who := _WHO.match(line.partition("access_control: ")[2]):
            if len(self._names) >= MAX_NAMES:
                self._names.clear()
            self._names[who[1]] = who[2]
        denied = _DENIED.search(line)
        if denied is None or not denied["cached"]:
            verdict = _VERDICT.search(line)
            if verdict is not None and self._working_out.get(thread) == verdict[1]:
                return None
        if "(ingress)" in line or "(egress)" in line:
            self._working_out.pop(thread, None)
        if denied is None:
            return None
        common_name = self._names.get(denied["zid"], "")
        return Denied(denied["zid"], common_name, denied["what"].strip(), denied["key"] or "")
