"""From a daemon's console to a broker, for as long as both are there, and again when they are back."""

from __future__ import annotations

import asyncio
import contextlib
import random
import secrets
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import aiomqtt

from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.mqtt.broker import Broker
from pneud.mqtt.facts import ONLINE, messages
from pneud.rt.processes import with_own

TIMEOUT_S = 10.0  # that a broker has to answer
KEEPALIVE_S = 15  # a broker takes a client for gone after half as much again
APART_S, FARTHEST_S = 1.0, 60.0  # from one try to the next; twice as long after each in vain
_HELD_S = 10.0  # a connection that has lasted for so long was none in vain
_LEAVE_S = 2.0  # for last words
_JITTER = 0.2  # part by which tries differ, so that many do not come back at once
_AT_ONCE = 100  # messages that may wait for the broker

Statuses = Sequence[Mapping[str, Any]]


class Daemon:
    """The daemon, looked at now and then; it is looked for again where it goes."""

    def __init__(self, connect: Callable[[], Client]) -> None:
        """Not yet connected.

        Args:
            connect: makes a connection; raises PlaceError.
        """
        self._connect = connect
        self._client: Client | None = None

    def look(self) -> Statuses:
        """The statuses of its axes, with what this process has used; blocks.

        Raises:
            PlaceError: there is none.
            RefusedError: it refuses to be looked at.
        """
        try:
            if self._client is None:
                client = self._connect()
                self._client = client
                client.ask("observe")
            return with_own(statuses_of(self._client.ask("status")), "mqtt")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Hang up."""
        client, self._client = self._client, None
        if client is not None:
            client.close()


def statuses_of(found: Mapping[str, Any]) -> Statuses:
    """The status of each axis in a reply."""
    return [*found["axes"].values()] if "axes" in found else [found]


class Bridge:
    """Publishes what has changed."""

    def __init__(self, daemon: Daemon, broker: Broker, topic: str, every_s: float) -> None:
        """Nothing is published yet.

        Args:
            daemon: to look at.
            broker: to tell.
            topic: that all stands under.
            every_s: how often to look.
        """
        self._daemon = daemon
        self._broker = broker
        self._topic = topic
        self._every_s = every_s
        self._told: dict[str, str] = {}  # what the broker has, by topic
        self._complaints: dict[str, str] = {}  # that hold, by whom they are about
        self._leave = asyncio.Event()

    async def run(self) -> None:
        """Until a signal says that it is enough."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            asyncio.get_running_loop().add_signal_handler(number, self._leave.set)
        apart_s = APART_S
        while not self._leave.is_set():
            begun_s = time.monotonic()
            try:
                await self._until_leaving()
            except aiomqtt.MqttError as e:
                self._complain("broker", f"{self._broker.url}: {_words(e)}")
                if time.monotonic() - begun_s > _HELD_S:
                    apart_s = APART_S
                await self._rest(apart_s * random.uniform(1.0 - _JITTER, 1.0 + _JITTER))
                apart_s = min(2.0 * apart_s, FARTHEST_S)

    async def _until_leaving(self) -> None:
        """One connection; whoever is to leave does not wait for a broker that says nothing."""
        leaving, task = (asyncio.create_task(one) for one in (self._leave.wait(), self._publish()))
        try:
            await asyncio.wait({leaving, task}, return_when=asyncio.FIRST_COMPLETED)
            await asyncio.wait({task}, timeout=_LEAVE_S)
        finally:
            leaving.cancel()
            task.cancel()
        if task.done():
            task.result()

    async def _publish(self) -> None:
        """One connection, until it is over or a signal comes."""
        b, online = self._broker, f"{self._topic}/{ONLINE}"
        async with aiomqtt.Client(
            b.host,
            b.port,
            username=b.user,
            password=b.password,
            tls_context=b.tls,
            identifier=f"pneud-{secrets.token_hex(8)}",
            will=aiomqtt.Will(online, "false", qos=1, retain=True),
            keepalive=KEEPALIVE_S,
            timeout=TIMEOUT_S,
            max_queued_outgoing_messages=_AT_ONCE,
        ) as client:
            self._told = {}
            self._praise("broker", b.url)
            gone = asyncio.create_task(_until_gone(client))
            try:
                while not self._leave.is_set():
                    await self._look(client, online)
                    await self._rest(self._every_s, gone)
                    if gone.done():
                        gone.result()
            finally:
                gone.cancel()
                await asyncio.gather(gone, return_exceptions=True)
                # in order, so that the broker does not have to find out that nobody is there
                with contextlib.suppress(aiomqtt.MqttError):
                    await self._tell(client, online, "false")

    async def _look(self, client: aiomqtt.Client, online: str) -> None:
        try:
            statuses = await asyncio.to_thread(self._daemon.look)
        except (PlaceError, RefusedError, OSError) as e:
            self._complain("daemon", str(e))
            await self._tell(client, online, "false")
            return
        self._praise("daemon", "the daemon")
        for topic, payload in messages(self._topic, statuses):
            await self._tell(client, topic, payload)
        await self._tell(client, online, "true")

    async def _tell(self, client: aiomqtt.Client, topic: str, payload: str) -> None:
        """Publish what is not yet known; whoever comes later gets the last word of each topic."""
        if self._told.get(topic) != payload:
            await client.publish(topic, payload, qos=1, retain=True)
            self._told[topic] = payload

    async def _rest(self, longest_s: float, *others: asyncio.Task[None]) -> None:
        """Until it is time, or something happens."""
        leaving = asyncio.create_task(self._leave.wait())
        await asyncio.wait({leaving, *others}, timeout=longest_s, return_when=asyncio.FIRST_COMPLETED)
        leaving.cancel()

    def _complain(self, about: str, words: str) -> None:
        """Say it once, as long as it stays so."""
        if self._complaints.get(about) != words:
            self._complaints[about] = words
            print(f"pneud: {words}; it is tried again", file=sys.stderr, flush=True)

    def _praise(self, about: str, whom: str) -> None:
        if self._complaints.pop(about, None) is not None:
            print(f"pneud: {whom} is back", file=sys.stderr, flush=True)


async def _until_gone(client: aiomqtt.Client) -> None:
    """Raises MqttError when the broker has gone, though nothing was to be told; it has nothing to say."""
    async for _ in client.messages:
        pass


def _words(e: aiomqtt.MqttError) -> str:
    """Why, in one line."""
    cause = e.__cause__
    if isinstance(cause, OSError) and cause.strerror:
        return cause.strerror
    return " ".join(str(e).split()) or type(e).__name__
