"""An operator's end of the console for a screen: never waits for an answer, comes back where it is lost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError

_MESSAGE_S = 6.0
_ASK_S = 2.0  # as often as what is learnt is handed over
_AGAIN_S = 1.0
_GRACE_S = 2.0  # a console may begin after its screen, and may be started again


class Operator:
    """Asks, and tells what the answers were.

    Attributes:
        look_only: it never commands.
        message: the last refusal, for a few seconds; that nobody hears, for as long as that is so.
        status: as the console told it last.
    """

    def __init__(
        self, connect: Callable[[], Client], client: Client | None = None, look_only: bool = False
    ) -> None:
        """Begin.

        Args:
            connect: makes a connection; raises PlaceError.
            client: one that there is already.
            look_only: say so to the console.
        """
        self.look_only = look_only
        self.message = ""
        self.status: dict[str, Any] = {}
        self._connect = connect
        self._client = client
        self._lost, self._lost_s = "", 0.0
        self._until_s = self._ask_s = self._again_s = 0.0
        self._now_s = 0.0

    def ask(self, verb: str, **fields: Any) -> None:
        """Ask without waiting; where nobody hears, the message says so."""
        self._reach()
        if self._client is not None:
            self._client.send(verb, **fields)
        else:
            self.message, self._until_s = self._lost, self._now_s + _MESSAGE_S

    def attend(self, now_s: float) -> None:
        """Read what has come, and ask for the status now and then; to be called many times a second."""
        self._now_s = now_s
        if self._client is None and now_s >= self._again_s:
            self._reach()
        if self._client is not None:
            try:
                if now_s >= self._ask_s:
                    self._ask_s = now_s + _ASK_S
                    self._client.send("status")
                for reply in self._client.replies():
                    self._take(reply)
            except PlaceError as e:
                self._lose(str(e))
        if now_s > self._until_s:
            self.message = self._lost if now_s > self._lost_s + _GRACE_S else ""

    def _reach(self) -> None:
        """Have a connection, if there can be one."""
        if self._client is not None:
            return
        try:
            client = self._connect()
            if self.look_only:
                client.ask("observe")
        except (PlaceError, RefusedError) as e:
            self._lose(str(e))
        else:
            self._client, self._lost, self._ask_s = client, "", 0.0

    def _lose(self, why: str) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
        self._again_s = self._now_s + _AGAIN_S
        if not self._lost:
            self._lost_s = self._now_s
        self._lost = f"nobody hears keys: {why}"

    def _take(self, reply: dict[str, Any]) -> None:
        if not reply.get("ok"):
            self.message, self._until_s = str(reply["error"]["message"]), self._now_s + _MESSAGE_S
        elif "learnt" in reply:
            self.status = reply
