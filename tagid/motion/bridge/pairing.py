"""Answers the system's pass-key prompt on Linux, which the user would otherwise answer outside tagid.

BlueZ asks an agent on the system bus; macOS and Windows show their own dialog and need no agent.
"""

# No postponed annotations here: dbus-fast reads the signatures of the methods from them.
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

_PATH = "/org/tagid/agent"
_BLUEZ = "org.bluez"
_MANAGER = "org.bluez.AgentManager1"


def _agent(passkey: str) -> Any:
    from dbus_fast.annotations import DBusObjectPath, DBusStr, DBusUInt32
    from dbus_fast.service import ServiceInterface, dbus_method

    class Agent(ServiceInterface):
        """org.bluez.Agent1 that answers with a fixed pass-key."""

        @dbus_method("Release")
        def release(self) -> None:
            """BlueZ released the agent."""

        @dbus_method("RequestPasskey")
        def request_passkey(self, device: DBusObjectPath) -> DBusUInt32:
            return int(passkey)

        @dbus_method("RequestPinCode")
        def request_pin_code(self, device: DBusObjectPath) -> DBusStr:
            return passkey

        @dbus_method("Cancel")
        def cancel(self) -> None:
            """BlueZ cancelled the request."""

    return Agent("org.bluez.Agent1")


@asynccontextmanager
async def answering(passkey: str | None) -> AsyncIterator[None]:
    """Answer BlueZ's prompt with `passkey` inside the context; no effect on other systems or without one.

    If BlueZ is missing or rejects the agent, nothing is reported here: pairing itself fails with an error.
    """
    if passkey is None or not sys.platform.startswith("linux"):
        yield
        return
    from dbus_fast import BusType, DBusError, Message
    from dbus_fast.aio import MessageBus

    bus = None
    with suppress(OSError, DBusError, EOFError):
        bus = await MessageBus(bus_type=BusType.SYSTEM).connect()
    if bus is None:
        yield
        return

    async def call(member: str, signature: str, *body: Any) -> None:
        await bus.call(
            Message(
                destination=_BLUEZ,
                path="/org/bluez",
                interface=_MANAGER,
                member=member,
                signature=signature,
                body=list(body),
            )
        )

    try:
        bus.export(_PATH, _agent(passkey))
        await call("RegisterAgent", "os", _PATH, "KeyboardOnly")
        # bleak pairs on its own connection, and BlueZ asks the default agent for those.
        await call("RequestDefaultAgent", "o", _PATH)
        yield
        await call("UnregisterAgent", "o", _PATH)
    finally:
        bus.disconnect()
