"""An `org.bluez` on a private bus with one bridge in the air, for stock bleak: run with the robot's tty.

It plays what BlueZ shows of a bridge with a pass-key: discovery, pairing through an agent, services, values.
"""

# No postponed annotations here: dbus-fast reads the signatures of the methods from them.
import asyncio
import os
import sys
import tty

from dbus_fast import BusType, DBusError, Message, MessageType, PropertyAccess
from dbus_fast.aio import MessageBus
from dbus_fast.service import ServiceInterface, dbus_method, dbus_property

from tagid.motion.bridge import protocol

ADAPTER = "/org/bluez/hci0"
DEVICE = ADAPTER + "/dev_F0_F1_F2_F3_F4_01"
NAME = "robot-1"
READ = PropertyAccess.READ
PASSKEY_FLAG, TRUSTED_FLAG = 2, 4


def shown(name, signature, value):
    """A property that can be read."""

    def get(self):
        return value(self)

    get.__name__, get.__annotations__["return"] = name, signature
    return dbus_property(READ)(get)


class Characteristic(ServiceInterface):
    def __init__(self, uuid, flags, handle, service, written=None, value=b""):
        super().__init__("org.bluez.GattCharacteristic1")
        self.uuid, self.flags, self.handle, self.service = uuid, flags, handle, service
        self.written, self.value, self.notifying = written, value, False

    UUID = shown("UUID", "s", lambda self: self.uuid)
    Service = shown("Service", "o", lambda self: self.service)
    Flags = shown("Flags", "as", lambda self: self.flags)
    Handle = shown("Handle", "q", lambda self: self.handle)
    MTU = shown("MTU", "q", lambda self: 247)
    Notifying = shown("Notifying", "b", lambda self: self.notifying)
    Value = shown("Value", "ay", lambda self: self.value)

    @dbus_method()
    def ReadValue(self, options: "a{sv}") -> "ay":
        return self.value

    @dbus_method()
    def WriteValue(self, value: "ay", options: "a{sv}"):
        if self.written is None:
            raise DBusError("org.bluez.Error.NotPermitted", "Write not permitted")
        self.written(bytes(value))

    @dbus_method()
    def StartNotify(self):
        self.notifying = True
        self.emit_properties_changed({"Notifying": True})

    @dbus_method()
    def StopNotify(self):
        self.notifying = False
        self.emit_properties_changed({"Notifying": False})

    def push(self, value):
        self.value = value
        self.emit_properties_changed({"Value": value})


class Service(ServiceInterface):
    def __init__(self, uuid, handle):
        super().__init__("org.bluez.GattService1")
        self.uuid, self.handle = uuid, handle

    UUID = shown("UUID", "s", lambda self: self.uuid)
    Device = shown("Device", "o", lambda self: DEVICE)
    Primary = shown("Primary", "b", lambda self: True)
    Handle = shown("Handle", "q", lambda self: self.handle)


class Device(ServiceInterface):
    def __init__(self, bus, uart, passkey):
        super().__init__("org.bluez.Device1")
        self.bus, self.uart, self.passkey = bus, uart, passkey
        self.connected = self.resolved = self.paired = self.trusted = False
        self.agent = None
        self.info = None

    Address = shown("Address", "s", lambda self: "F0:F1:F2:F3:F4:01")
    AddressType = shown("AddressType", "s", lambda self: "random")
    Name = shown("Name", "s", lambda self: NAME)
    Alias = shown("Alias", "s", lambda self: NAME)
    Adapter = shown("Adapter", "o", lambda self: ADAPTER)
    RSSI = shown("RSSI", "n", lambda self: -50)
    UUIDs = shown("UUIDs", "as", lambda self: [protocol.NUS])
    Paired = shown("Paired", "b", lambda self: self.paired)

    @dbus_property()
    def Trusted(self) -> "b":
        return self.trusted

    @Trusted.setter
    def Trusted(self, value: "b"):
        self.trusted = value

    Connected = shown("Connected", "b", lambda self: self.connected)
    ServicesResolved = shown("ServicesResolved", "b", lambda self: self.resolved)

    @dbus_method()
    async def Connect(self):
        self.connected = True
        self.emit_properties_changed({"Connected": True})
        if self.info is None:
            self._export()
        self.resolved = True
        self.emit_properties_changed({"ServicesResolved": True})

    @dbus_method()
    def Disconnect(self):
        self.resolved = self.connected = False
        self.emit_properties_changed({"ServicesResolved": False, "Connected": False})

    @dbus_method()
    async def Pair(self):
        if self.agent is None:
            raise DBusError("org.bluez.Error.AuthenticationFailed", "no agent")
        sender, path = self.agent
        answer = await self.bus.call(
            Message(
                destination=sender,
                path=path,
                interface="org.bluez.Agent1",
                member="RequestPasskey",
                signature="o",
                body=[DEVICE],
            )
        )
        if answer.message_type is MessageType.ERROR or answer.body[0] != self.passkey:
            raise DBusError("org.bluez.Error.AuthenticationFailed", "wrong pass-key")
        self.paired = True
        self.info.value = self._information()
        self.emit_properties_changed({"Paired": True})

    def _information(self):
        flags = 1 | PASSKEY_FLAG | (TRUSTED_FLAG if self.paired else 0)
        return bytes([protocol.PROTOCOL, 1, 0, 0, flags]) + b"robot-1;esp32;1.27"

    def _export(self):
        first, two = DEVICE + "/service0001", DEVICE + "/service0010"
        tx = Characteristic(protocol.NUS_TX, ["notify"], 4, first)
        event = Characteristic(protocol.EVENT, ["notify"], 14, two)
        self.info = Characteristic(protocol.INFO, ["read"], 16, two, value=self._information())

        def command(data):
            payload = data[2:4] if data[0] == protocol.Op.ARM else b""
            status = 0 if self.paired else 3
            event.push(bytes([data[0] | 0x80, data[1], status]) + payload)

        def to_robot(data):
            if not self.paired:
                raise DBusError("org.bluez.Error.NotAuthorized", "not paired")
            os.write(self.uart, data)

        rx = Characteristic(protocol.NUS_RX, ["write", "write-without-response"], 2, first, to_robot)
        orders = Characteristic(protocol.COMMAND, ["write"], 12, two, command)
        self.bus.export(first, Service(protocol.NUS, 1))
        self.bus.export(two, Service(protocol.CONTROL, 10))
        for characteristic in (rx, tx):
            self.bus.export(f"{first}/char{characteristic.handle:04x}", characteristic)
        for characteristic in (orders, event, self.info):
            self.bus.export(f"{two}/char{characteristic.handle:04x}", characteristic)

        def from_robot():
            data = os.read(self.uart, 240)
            if tx.notifying:
                tx.push(data)

        asyncio.get_running_loop().add_reader(self.uart, from_robot)


class Adapter(ServiceInterface):
    def __init__(self, bus, device):
        super().__init__("org.bluez.Adapter1")
        self.bus, self.device, self.discovering, self.shown, self.task = bus, device, False, False, None
        self.errors = sys.argv[3:]

    Address = shown("Address", "s", lambda self: "AA:BB:CC:00:00:01")
    Name = shown("Name", "s", lambda self: "hci0")
    Powered = shown("Powered", "b", lambda self: True)
    Discovering = shown("Discovering", "b", lambda self: self.discovering)
    Roles = shown("Roles", "as", lambda self: ["central", "peripheral"])

    @dbus_method()
    def SetDiscoveryFilter(self, properties: "a{sv}"):
        pass

    @dbus_method()
    def StartDiscovery(self):
        if self.errors:
            raise DBusError(self.errors.pop(0), "as asked")
        self.discovering = True
        self.emit_properties_changed({"Discovering": True})
        if not self.shown:
            self.shown = True
            self.bus.export(DEVICE, self.device)
        self.task = asyncio.get_running_loop().create_task(self._advertise())

    @dbus_method()
    def StopDiscovery(self):
        self.task.cancel()
        self.discovering = False
        self.emit_properties_changed({"Discovering": False})

    async def _advertise(self):
        while True:
            await asyncio.sleep(0.1)
            self.device.emit_properties_changed({"RSSI": -51})

    @dbus_method()
    def RemoveDevice(self, path: "o"):
        pass


async def main():
    uart = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(uart)
    bus = await MessageBus(bus_type=BusType.SYSTEM).connect()
    device = Device(bus, uart, int(sys.argv[2]))

    def agents(message):
        if message.interface != "org.bluez.AgentManager1":
            return None
        if message.member == "RegisterAgent":
            device.agent = message.sender, message.body[0]
        elif message.member == "UnregisterAgent":
            device.agent = None
        return Message.new_method_return(message)

    bus.add_message_handler(agents)
    bus.export(ADAPTER, Adapter(bus, device))
    await bus.request_name("org.bluez")
    print("ready", flush=True)
    await asyncio.get_running_loop().create_future()


if __name__ == "__main__":
    asyncio.run(main())
