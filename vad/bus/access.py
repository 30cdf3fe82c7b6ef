"""Who may do what on the bus from the network: roles, and the access rules zenoh keeps them by. Pure.

| role | may |
|---|---|
| viewer | ask for and subscribe to the keys in READABLE; write nothing |
| agent | everything below `vad/<hub>/agents/<its name>/`; read what READABLE_BY_AGENTS says; nothing else |
| admin | everything |

A message passes only where a rule includes its key: who subscribes to `vad/**` as a viewer hears nothing,
because that includes keys that are not a viewer's. Whoever has no rule can do nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

from vad.pki.certificates import Role

READABLE = (
    "vad/*/alive",
    "vad/*/status",
    "vad/*/map/**",
    "vad/*/devices/**",
    "vad/*/cameras/*",
    "vad/*/capture/*",
    "vad/*/events/**",
    "vad/*/schema/**",
)
"""A viewer's keys: no CSI, no frames, nothing of agents. Of any hub, so that `vad devices` needs no name."""

READABLE_BY_AGENTS = ("vad/{hub}/alive", "vad/{hub}/capture/*", "vad/{hub}/schema/**")
OWN = "vad/{hub}/agents/{name}/**"
ASKED_OF_AGENTS = "vad/{hub}/agents/*/**"
"""What the hub may ask an agent: also a question to all of them, which each answers for itself."""

Flow = Literal["ingress", "egress"]
LOCAL_LINK = "tcp"
"""The protocol of the link to the daemon; clients come over TLS."""

_ASK = ("query", "declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
_GET = ("put", "delete", "reply", "liveliness_token")
_ALL = (*_ASK, *_GET, "declare_queryable")


class Holder(NamedTuple):
    """A certificate in force. name: an agent's is its key."""

    common_name: str
    role: Role
    name: str


def access_control(hub: str, holders: Iterable[Holder]) -> dict[str, Any]:
    """zenoh's `access_control` section for one hub: the daemon's own link, these holders by common name."""
    holders = sorted(holders)
    rules = [
        _rule("everything", ("ingress", "egress"), _ALL, ["**"]),
        _rule("viewer asks", ("ingress",), _ASK, READABLE),
        _rule("viewer gets", ("egress",), _GET, READABLE),
        _rule("agent asks", ("ingress",), _ASK, _for_hub(READABLE_BY_AGENTS, hub)),
        _rule("agent gets", ("egress",), _GET, _for_hub(READABLE_BY_AGENTS, hub)),
        _rule("agent is asked", ("egress",), ("query",), [ASKED_OF_AGENTS.format(hub=hub)]),
    ]
    subjects: list[dict[str, Any]] = [{"id": "daemon", "link_protocols": [LOCAL_LINK]}]
    policies = [_policy(["everything"], ["daemon"])]
    for role, granted in (("admin", ["everything"]), ("viewer", ["viewer asks", "viewer gets"])):
        names = [h.common_name for h in holders if h.role == role]
        if names:
            subjects.append({"id": role, "cert_common_names": names})
            policies.append(_policy(granted, [role]))
    for name in sorted({h.name for h in holders if h.role == "agent"}):
        subject = f"agent {name}"
        own = _rule(subject, ("ingress", "egress"), _ALL, [OWN.format(hub=hub, name=name)])
        rules.append(own)
        names = [h.common_name for h in holders if (h.role, h.name) == ("agent", name)]
        subjects.append({"id": subject, "cert_common_names": names})
        policies.append(_policy([subject, "agent asks", "agent gets", "agent is asked"], [subject]))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _for_hub(keys: Iterable[str], hub: str) -> list[str]:
    return [key.format(hub=hub) for key in keys]


def _rule(name: str, flows: tuple[Flow, ...], messages: Iterable[str], keys: Iterable[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": list(flows),
        "messages": list(messages),
        "key_exprs": list(keys),
    }


def _policy(rules: list[str], subjects: list[str]) -> dict[str, Any]:
    return {"rules": rules, "subjects": subjects}
