"""docs/protocol.md: what a client may say to the console, from the models that judge it."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

from annotated_types import MaxLen, MinLen
from pydantic.fields import FieldInfo

from generators.configuration import kind, meanings
from generators.tables import HEAD, table
from pneud.console.line_stream import MAX_LINE
from pneud.console.protocol import VERBS, Error, Plain, RequestBase
from pneud.signals import Answer

_INTRO = """\
# The console's protocol

{head}

A running daemon serves one Unix socket ([where it is](console.md#where-the-socket-is)); whatever can open it and write JSON can
command the axis: [who may](console.md#who-commands). One JSON object a line, at most {most} bytes, in UTF-8. `v` is 1; `id` is a
number of the client's, which the reply repeats. Replies come in the order in which requests are done. Lengths are millimetres in
the stroke coordinate, times seconds. Unknown fields are refused.

Where a daemon has [several axes](axes.md), every request may have `axis`, a name. `stop` and `restart` are for all, whatever they
name; `arm`, `disarm`, `clear`, `hold`, `mark` and `status` are for all where they name none; all others have to name one. What is
asked of several is asked in one tick, and the reply names them in `axes`; to arm and to `goto_all` either all do, or none.

[`pneud.Client`](python.md#a-running-axis) does all of this from Python.

## Requests

| request | field | value | default | |
|---|---|---|---|---|
{requests}

`run` without `program` goes on in the record that was stopped. `upload` takes up to 32 pieces a line: duration [s] and eight coefficients of the powers of time, in metres; `first` empties
what is there, and what a client or a console leaves half uploaded is emptied; what follows a line that was refused is refused.
With the reply to `attach` comes a descriptor of the ring's memory, sealed against writing (`SCM_RIGHTS`).

## A conversation

`>` is the client, `<` the console; replies are shortened.

```
{conversation}
```

## Errors

{errors}

Up to 32 clients are served; a further one displaces the longest idle. A client gets 100 requests a second, and 200 at once; what
comes faster waits. Who leaves replies unread for five seconds is dropped.
"""
_ERRORS = {
    ("malformed", "too_long", "version", "unknown_verb", "invalid"): (
        "the line is no request; after `too_long` the console hangs up"
    ),
    ("read_only", "busy"): "who asks may not command; another client does",
    ("full", "displaced"): "too many requests wait; a stop came first, or too many clients did",
    ("silent", "late"): "the loop does not answer; it came to it too late, and has not done it",
    ("configuration",): "the file cannot be used",
    ("program",): "the program cannot be used: the message names the record, and the cure",
    (
        *(
            "wrong_state",
            "blocked",
            "out_of_travel",
            "beyond_limits",
            "unstable",
            "not_referenced",
            "no_profile",
        ),
        *("closing",),
    ): "the axis says no",
}
_CONVERSATION = """\
> {"v": 1, "id": 1, "verb": "arm"}
< {"v": 1, "id": 1, "ok": true, "state": "holding"}
> {"v": 1, "id": 2, "verb": "goto", "x_mm": 120.0, "speed_mm_s": 50.0}
< {"v": 1, "id": 2, "ok": true, "order": 2, "state": "holding"}
> {"v": 1, "id": 3, "verb": "goto", "x_mm": 1200.0}
< {"v": 1, "id": 3, "ok": false, "error": {"type": "out_of_travel", "message": "1200 mm lies outside the travel 21 … 979 mm; the nearest allowed is 979 mm", "nearest_mm": 979.0}}
> {"v": 1, "id": 3, "verb": "force", "force_n": 5000}
< {"v": 1, "id": 3, "ok": false, "axis": "virtual", "error": {"type": "beyond_limits", "message": "5000 N are more than limits.force and the supply allow; at most 564.3 N"}}
> {"v": 1, "id": 3, "verb": "goto_all", "axes": {"virtual": 120.0}}
< {"v": 1, "id": 3, "ok": false, "error": {"type": "wrong_state", "message": "goto: virtual is starting; axes set out together from where they hold"}}
> {"v": 1, "id": 4, "verb": "jog", "velocity_mm_s": -20.0, "lease_s": 0.3}
< {"v": 1, "id": 4, "ok": true, "state": "holding"}
> {"v": 1, "id": 5, "verb": "hold"}
< {"v": 1, "id": 5, "ok": true, "state": "holding"}
> {"v": 1, "id": 6, "verb": "track", "what": "reference"}
< {"v": 1, "id": 6, "ok": true, "state": "holding"}
> {"v": 1, "id": 7, "verb": "upload", "first": true, "pieces": [[0.5, 0.3, 0, 0, 0, 0, 0, 0, 0]]}
< {"v": 1, "id": 7, "ok": true, "state": "holding"}
> {"v": 1, "id": 8, "verb": "track", "what": "profile"}
< {"v": 1, "id": 8, "ok": true, "state": "holding"}
> {"v": 1, "id": 8, "verb": "run", "program": {"schema": 1, "record": [{"do": "goto", "to_mm": 120.0}, {"do": "wait", "for_s": 0.5}]}, "cycles": 2}
< {"v": 1, "id": 8, "ok": true, "records": 2, "state": "holding"}
> {"v": 1, "id": 8, "verb": "run", "program": {"schema": 1, "record": [{"do": "goto", "to_mm": 1200.0}]}}
< {"v": 1, "id": 8, "ok": false, "error": {"type": "program", "message": "run: record 1 (goto): 1200 mm lies outside the travel 21 … 979 mm; the nearest allowed is 979 mm"}}
> {"v": 1, "id": 9, "verb": "tune_set", "gains": {"k1": 90000.0, "reference.amplitude_m": 0.04}}
< {"v": 1, "id": 9, "ok": true, "changed": "k1 95000 → 90000, reference.amplitude_m 0.05 → 0.04", "state": "holding"}
> {"v": 1, "id": 10, "verb": "tune_get"}
< {"v": 1, "id": 10, "ok": true}
> {"v": 1, "id": 11, "verb": "tune_reload"}
< {"v": 1, "id": 11, "ok": true, "changed": "k1 90000 → 95000, reference.amplitude_m 0.04 → 0.05", "at_restart": []}
> {"v": 1, "id": 12, "verb": "mark", "text": "oil changed"}
< {"v": 1, "id": 12, "ok": true, "state": "holding"}
> {"v": 1, "id": 13, "verb": "stop"}
< {"v": 1, "id": 13, "ok": true, "state": "holding"}
> {"v": 1, "id": 14, "verb": "clear"}
< {"v": 1, "id": 14, "ok": true}
> {"v": 1, "id": 15, "verb": "home"}
< {"v": 1, "id": 15, "ok": true}
> {"v": 1, "id": 15, "verb": "probe", "voltage_v": 1.25, "rate_v_s": 0.1, "travel_mm": 1.0, "speed_mm_s": 30.0, "force_n": 20.0}
< {"v": 1, "id": 15, "ok": true}
> {"v": 1, "id": 15, "verb": "restart"}
< {"v": 1, "id": 15, "ok": true}
> {"v": 1, "id": 16, "verb": "disarm"}
< {"v": 1, "id": 16, "ok": true}
> {"v": 1, "id": 17, "verb": "status"}
< {"v": 1, "id": 17, "ok": true, "schema": 1, "state": "starting", "faults": [], "in_position": false, "hunting": null, "rate_hz": 1000.0, "log_dropped": 0}
> {"v": 1, "id": 18, "verb": "attach"}
< {"v": 1, "id": 18, "ok": true, "slots": 64}
> {"v": 1, "id": 19, "verb": "observe"}
< {"v": 1, "id": 19, "ok": true}
> {"v": 1, "id": 20, "verb": "arm"}
< {"v": 1, "id": 20, "ok": false, "error": {"type": "read_only"}}
> {"v": 2, "id": 21, "verb": "arm"}
< {"v": 1, "id": 21, "ok": false, "error": {"type": "version", "message": "this console speaks version 1: give v = 1"}}
> {"v": 1, "id": 22, "verb": "goto", "x_mm": "here"}
< {"v": 1, "id": 22, "ok": false, "error": {"type": "invalid", "message": "x_mm: Input should be a valid number"}}
> stop!
< {"v": 1, "id": null, "ok": false, "error": {"type": "malformed"}}
"""
_SAYS_IT_ALL = {"stop": "whoever commands; then hold or centre, as configured"}  # verbs without a comment
_BY_LENGTH = {  # how to say what has a length; bounds are those of the models
    "pieces": "list of {least} to {most} pieces, nine numbers each",
    "gains": "table of {least} to {most} names with their values",
    "axes": "table of {least} to {most} axes with their positions",
    "text": "{least} to {most} characters",
}


def _errors() -> str:
    """The errors by what they mean; every one that there is stands in one line."""
    known = {e.value for e in Error} | {a.name.lower() for a in Answer if a > Answer.TAKEN}
    assert {name for names in _ERRORS for name in names} == known
    rows = [(", ".join(f"`{name}`" for name in names), means) for names, means in _ERRORS.items()]
    return table(("error", "means"), rows)


def _plain() -> dict[str, str]:
    """The verbs that say it all, with the comments behind them."""
    found = dict(re.findall(r'^        "(\w+)",(?:  # (.*))?$', inspect.getsource(Plain), re.MULTILINE))
    return {verb: said or _SAYS_IT_ALL[verb] for verb, said in found.items()}


def _requests() -> Iterator[str]:
    """A line for each field of each request, and one for each that has none."""
    for verb, said in _plain().items():
        yield f"| `{verb}` | | | | {said} |"
    for verb, model in VERBS.items():
        if model is Plain:
            continue
        said = (inspect.getdoc(model) or "").splitlines()[0].rstrip(".")
        yield f"| `{verb}` | | | | {said[0].lower()}{said[1:]} |"
        comments = meanings(model)
        for name, field in model.model_fields.items():
            if name in RequestBase.model_fields or name == "verb":
                continue
            default = "**required**" if field.is_required() else _default(name, field.default)
            yield f"| | `{name}` | {_value(name, field)} | {default} | {comments.get(name, '')} |"


def _value(name: str, field: FieldInfo) -> str:
    """What a field may be."""
    if name == "program":
        return "[a program](programs.md) as tables"
    if name not in _BY_LENGTH:
        return kind(field.annotation, field.metadata).replace("e+0", "e")
    (least,) = (m.min_length for m in field.metadata if isinstance(m, MinLen))
    (most,) = (m.max_length for m in field.metadata if isinstance(m, MaxLen))
    return _BY_LENGTH[name].format(least=least, most=most)


def _default(name: str, value: object) -> str:
    usual = "the one that was stopped" if name == "program" else "as configured"
    return usual if value is None else f"`{str(value).lower()}`"


def text() -> str:
    """The page."""
    return _INTRO.format(
        head=HEAD.format(name="protocol"),
        most=MAX_LINE,
        requests="\n".join(_requests()),
        conversation=_CONVERSATION.strip(),
        errors=_errors(),
    )


if __name__ == "__main__":
    print(text(), end="")
