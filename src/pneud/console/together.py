"""Requests where one console has several axes: which of them are meant, and what all are asked at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pneud.console import programs, protocol
from pneud.console.orders import Desk, Orders
from pneud.console.protocol import Error, ProtocolError
from pneud.console.records import ProgramError
from pneud.control.together import alike
from pneud.signals import Answer, Request, RequestKind

_MM = 1e-3
_PROFILE = Request(RequestKind.TRACK, (1.0,))  # follow the one that was uploaded
_ALL = frozenset(("arm", "disarm", "clear", "hold", "mark"))  # where no axis is named
_ALWAYS_ALL = frozenset(("stop", "restart"))
_BOTH = frozenset(("arm", "disarm", "clear"))  # of a gantry, whichever half is named
_LED = frozenset(("goto", "jog", "track", "upload", "home", "probe"))  # nothing that one half could do alone


def meant(desks: Sequence[Desk], message: protocol.Request) -> tuple[int, ...]:
    """The places of the axes that a request is for.

    A stop is for all, whatever it names. What could move something is for none that it does not name.

    Raises:
        ProtocolError: it names one that is not there, or has to name one and does not.
    """
    names = [desk.name for desk in desks]
    if message.verb in _ALWAYS_ALL:
        return tuple(range(len(desks)))
    if message.axis is not None and message.axis not in names:
        raise ProtocolError(Error.INVALID, f"no axis {message.axis!r}; there is {', '.join(names)}")
    if message.axis is not None:
        return _halves(desks, names.index(message.axis), message.verb)
    if len(desks) == 1 or message.verb in _ALL:
        return tuple(range(len(desks)))
    raise ProtocolError(Error.INVALID, f"{message.verb} names no axis; give one of {', '.join(names)}")


def _halves(desks: Sequence[Desk], axis: int, verb: str) -> tuple[int, ...]:
    """An axis, and the other half of its gantry where that has to do the same.

    Raises:
        ProtocolError: it is the half that the other one leads.
    """
    if verb in _LED:
        _check_free(desks[axis], verb)
    if verb not in _BOTH:
        return (axis,)
    name, leader = desks[axis].name, desks[axis].carried_by
    return tuple(
        n
        for n, desk in enumerate(desks)
        if n == axis or (leader and desk.name == leader) or desk.carried_by == name
    )


def _check_free(desk: Desk, verb: str) -> None:
    if desk.carried_by:
        words = f"{verb}: {desk.name} is carried with {desk.carried_by}, as a gantry; ask {desk.carried_by}"
        raise ProtocolError(Error.INVALID, words, axis=desk.name)


def whose(desks: Sequence[Desk], orders: Orders) -> str:
    """Whose it is, for the log, where there are several axes."""
    return f"{', '.join(desks[axis].name for axis in orders.axes)}: " if len(desks) > 1 else ""


def half_done(desks: Sequence[Desk], axes: Sequence[int], undo: Request | None) -> None:
    """Have axes know what to undo where all ends here; None: what was begun is whole, or undone."""
    for axis in axes:
        desks[axis].half_done(undo)


def took_nothing(desks: Sequence[Desk], plan: Orders, coming: Orders | None) -> None:
    """Have axes that have refused the first of something know what is to be undone as before."""
    if plan.undo is None or plan.follows:
        return
    for axis in plan.axes:
        half_done(desks, (axis,), coming.undo if coming is not None and axis in coming.axes else None)


def too_soon(plan: Orders, coming: Orders | None, *, own: bool) -> ProtocolError | None:
    """Why what has come to its turn may not be asked, with a profile that is there in part, or with none.

    Args:
        plan: what is to be asked.
        coming: the upload that is not whole; None where there is none.
        own: it is of the same client.
    """
    if plan.follows and (coming is None or not own):
        return ProtocolError(Error.INVALID, "the upload has not begun, or was refused")
    if coming is not None and plan.requests[0] == _PROFILE and not set(plan.axes).isdisjoint(coming.axes):
        return ProtocolError(Answer.NO_PROFILE.name.lower(), f"{plan.words}: it is still being uploaded")
    return None


def plan(desks: Sequence[Desk], message: protocol.Request) -> Orders:
    """What to ask of the loop, of all axes that a request is for.

    Raises:
        ProtocolError: what is asked for cannot be done, as one of them says.
    """
    if isinstance(message, protocol.GotoAll):
        return goto(desks, message)
    if isinstance(message, protocol.Run) and message.axis is None and len(desks) > 1:
        return run(desks, message)
    axes = meant(desks, message)
    if message.verb == "restart":
        _check_idle(desks)
    try:
        return desks[axes[0]].plan(message)._replace(axes=axes)
    except ProtocolError as e:
        e.axis = desks[axes[0]].name if len(desks) > 1 else ""
        raise


def _check_idle(desks: Sequence[Desk]) -> None:
    """No file is read for what is refused anyway: on a disk that stalls, that would stop an engaged axis.

    Raises:
        ProtocolError: an axis is engaged.
    """
    for desk in desks:
        if state := desk.engaged_in():
            words = f"restart: not while the axis is {state}"
            error = ProtocolError(Answer.WRONG_STATE.name.lower(), words, state=state)
            error.axis = desk.name if len(desks) > 1 else ""
            raise error


def _have(desks: Sequence[Desk], axes: Sequence[str]) -> bool:
    """Whether the program that axes were given together is still that of each of them."""
    return all(desk.shares() == axes for desk in desks if desk.name in axes)


def run(desks: Sequence[Desk], message: protocol.Run) -> Orders:
    """Have a program done by all axes that it names, each record when all have done the one before.

    Raises:
        ProtocolError: the program cannot be used, or there is none to go on with.
    """
    names = [desk.name for desk in desks]
    if message.program is None:
        all_of = (desk.shares() for desk in desks)
        shared = next((found for found in all_of if len(found) > 1 and _have(desks, found)), ())
        if not shared:
            raise ProtocolError(Error.INVALID, f"run names no axis; give one of {', '.join(names)}")
        axes = tuple(names.index(name) for name in shared)
        asked = (Request(RequestKind.RUN, (0.0, 0.0, 1.0)),)
        return Orders("run, from where it was stopped", asked, axes=axes, attended=message.attended)
    try:
        named = programs.named(message.program)
        chosen = [n for n, desk in enumerate(desks) if desk.name in named] or list(range(len(desks)))
        found = programs.compiled(message.program, [desks[n].facts() for n in chosen])
        lists = programs.requests_to_begin(found, message.record, message.cycles)
    except ProgramError as e:
        raise ProtocolError(Error.PROGRAM, f"run: {e}") from None
    steps = tuple(dict(zip(chosen, each, strict=True)) for each in zip(*lists, strict=True))

    def taken() -> dict[str, Any]:
        for n in chosen:
            desks[n].taken(found)
        return {"records": len(found.records)}

    if message.load:
        raise ProtocolError(Error.INVALID, "run: what an input begins is a program of one axis; name it")
    words = programs.run_in_words(found, message.record, message.cycles)
    return Orders(
        words,
        tuple(lists[0]),
        undo=programs.EMPTY,
        axes=tuple(chosen),
        steps=steps,
        attended=message.attended,
        done=taken,
    )


def goto(desks: Sequence[Desk], message: protocol.GotoAll) -> Orders:
    """Set out together and arrive together, by one law of time that keeps everybody's limits.

    Axes that are in motion come to rest first.

    Raises:
        ProtocolError: an axis is not there, neither holds nor moves, or cannot go there.
    """
    names = [desk.name for desk in desks]
    targets: dict[int, float] = {}
    for name, x_mm in message.axes.items():
        if name not in names:
            raise ProtocolError(Error.INVALID, f"no axis {name!r}; there is {', '.join(names)}")
        _check_free(desks[names.index(name)], "goto")
        targets[names.index(name)] = x_mm
    ways, bounds, moving = [], [], []
    for axis, x_mm in targets.items():
        desk = desks[axis]
        try:
            desk.plan(protocol.Goto(v=1, id=message.id, verb="goto", x_mm=float(x_mm)))
            if desk.moves():
                moving.append(axis)
                continue
            ways.append(abs(x_mm * _MM - desk.stands_m()))
        except ProtocolError as e:
            e.axis = desk.name
            raise
        bounds.append(desk.bounds(ways[-1]))
    if moving:
        rest = Request(RequestKind.HOLD)
        return Orders("hold, to set out together", (rest,), axes=tuple(moving), then=message)
    each = {
        axis: Request(RequestKind.GOTO, (x_mm * _MM, *kept))
        for (axis, x_mm), kept in zip(targets.items(), alike(ways, bounds), strict=True)
    }
    words = "goto " + ", ".join(f"{name} {x_mm:g} mm" for name, x_mm in message.axes.items())
    return Orders(words, (next(iter(each.values())),), axes=tuple(each), each=each)
