"""A status as messages: the facts of the metrics, as plain JSON under topics."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from pneud.web.metrics import GROUPS, Family

ONLINE = "online"
_ONE = ("state", "hunting")  # metrics of which one label holds at most: its name says all
_SOME = ("fault_present", "fault_latched")  # or some
_LONGEST = 256  # bytes of a topic before those that pneud adds


class TopicError(Exception):
    """No message can have such a topic; the text is one line for a person."""

    exit_code = 2


class Message(NamedTuple):
    """What is to be published."""

    topic: str
    payload: str


def checked(topic: str) -> str:
    """A topic that others can stand under.

    Raises:
        TopicError: it is none.
    """
    if not topic or re.search(r"[+#\x00-\x1f\x7f]", topic) or topic.startswith(("$", "/")):
        raise TopicError(f"--topic {topic}: no topic; letters with / between them, such as plant/press")
    if topic.endswith("/") or "//" in topic or len(topic.encode(errors="replace")) > _LONGEST:
        raise TopicError(f"--topic {topic}: has empty levels, or is longer than {_LONGEST} bytes")
    return topic


def level(name: str) -> str:
    """A name as a level of a topic."""
    return re.sub(r"[+#/$\x00-\x1f\x7f]", "-", name) or "-"


def messages(topic: str, statuses: Sequence[Mapping[str, Any]]) -> Iterator[Message]:
    """All facts of a daemon.

    Args:
        topic: that all stand under.
        statuses: of its axes; where there are several, each has a level of its own.
    """
    for status in statuses:
        below = topic if len(statuses) == 1 else f"{topic}/{level(str(status['name']))}"
        for group, families in GROUPS.items():
            facts = {family.name: _value(family) for family in families(status)}
            yield Message(f"{below}/{group}", json.dumps(facts, separators=(",", ":"), allow_nan=False))


def _value(family: Family) -> Any:
    """What a metric says: a number, or one by each label; null where nobody knows."""
    samples = [(behind, labels, _number(value)) for behind, labels, value in family.samples]
    if family.kind == "histogram":
        le = {labels["le"]: value for behind, labels, value in samples if behind == "_bucket"}
        rest = {behind.lstrip("_"): value for behind, labels, value in samples if behind != "_bucket"}
        return {"le": le, **rest}
    if family.name in (*_ONE, *_SOME):
        held = [next(iter(labels.values())) for _, labels, value in samples if value]
        return held if family.name in _SOME else next(iter(held), None)
    if family.name == "info":
        return samples[0][1]
    if len(samples) == 1 and not samples[0][1]:
        return samples[0][2]
    found: dict[str, Any] = {}
    for _, labels, value in samples:
        *outer, last = labels.values()
        inner = found
        for label in outer:
            inner = inner.setdefault(label, {})
        inner[last] = value
    return found


def _number(value: float) -> float | int | None:
    if not math.isfinite(value):
        return None
    return int(value) if value == int(value) else float(f"{value:.12g}")
