"""The host's side: advertising, the two services, and pairing with the pass-key.

A write that arrives before the link is authenticated goes nowhere, whether the stack refused it or not.
"""

import json
from binascii import hexlify, unhexlify
from struct import pack
from time import ticks_diff, ticks_ms

import bluetooth
from micropython import const

_CONNECT = const(1)
_DISCONNECT = const(2)
_WRITE = const(3)
_MTU = const(21)
_ENCRYPTION = const(28)
_GET_SECRET = const(29)
_SET_SECRET = const(30)
_PASSKEY = const(31)

_READ = const(0x0002)
_WRITE_SILENT = const(0x0004)
_WRITE_ASKED = const(0x0008)
_NOTIFY = const(0x0010)
_WRITE_PAIRED = const(0x3000)  # encrypted and authenticated

_SHOW_PASSKEY = const(3)
_DISPLAY_ONLY = const(0)

NUS = bluetooth.UUID("6E400001-B5A3-F393-E0A9-E50E24DCCA9E")
NUS_RX = bluetooth.UUID("6E400002-B5A3-F393-E0A9-E50E24DCCA9E")
NUS_TX = bluetooth.UUID("6E400003-B5A3-F393-E0A9-E50E24DCCA9E")
CONTROL = bluetooth.UUID("7D1C0001-3A6E-4F52-9B0D-7461676964B1")
COMMAND = bluetooth.UUID("7D1C0002-3A6E-4F52-9B0D-7461676964B1")
EVENT = bluetooth.UUID("7D1C0003-3A6E-4F52-9B0D-7461676964B1")
INFO = bluetooth.UUID("7D1C0004-3A6E-4F52-9B0D-7461676964B1")

MTU = const(247)
_DEFAULT_MTU = const(23)
_ADVERTISE_US = const(100000)
_BONDS = "bonds.json"
# A fixed pass-key gives a little of itself away with every failed try, so tries are few until a power cycle.
_TRIES = const(5)
_PAIRING_MS = const(60000)


class Radio:
    """One peripheral that serves one host at a time.

    Args:
        name: advertised name.
        passkey: six digits, or None for a bridge that anyone may use.
        info: bytes to read without pairing.
        on_bytes, on_command, on_lost: called from the stack's interrupt with bytes, bytes, nothing.
    """

    def __init__(self, name, passkey, on_bytes, on_command, on_lost):
        self._passkey = passkey
        self._on_bytes = on_bytes
        self._on_command = on_command
        self._on_lost = on_lost
        self._connection = None
        self._paired = False
        self._since = 0
        self._tries = 0
        self._bonds = None
        self._bonds_changed = False
        self._advertise_due = True
        self.mtu = _DEFAULT_MTU
        self.retries = 0
        self.refused = 0
        self._payloads = self._advertisement(name)
        self._ble = bluetooth.BLE()
        self._ble.active(True)
        self._ble.config(gap_name=name, mtu=MTU, rxbuf=2048)
        guard = 0
        if passkey is not None:
            self._bonds = _load_bonds()
            self._ble.config(bond=True, mitm=True, le_secure=True, io=_DISPLAY_ONLY)
            guard = _WRITE_PAIRED
        self._ble.irq(self._irq)
        handles = self._ble.gatts_register_services(
            (
                (NUS, ((NUS_RX, _WRITE_ASKED | _WRITE_SILENT | guard), (NUS_TX, _NOTIFY | _READ))),
                (CONTROL, ((COMMAND, _WRITE_ASKED | guard), (EVENT, _NOTIFY | _READ), (INFO, _READ))),
            )
        )
        (self._rx, self._tx), (self._command, self._event, self._info) = handles
        # An attribute holds 20 bytes unless told; in append mode two writes before one read lose nothing.
        self._ble.gatts_set_buffer(self._rx, 1024, True)
        self._ble.gatts_set_buffer(self._command, MTU)

    def _advertisement(self, name):
        # Legacy advertising has 31 bytes: flags and service fill 21, so the name goes into the scan response.
        service = bytes(NUS)
        text = name.encode()
        data = b"\x02\x01\x06" + pack("BB", len(service) + 1, 7) + service
        return data, pack("BB", len(text) + 1, 9) + text

    def connected(self):
        """Whether a host is there."""
        return self._connection is not None

    def trusted(self):
        """Whether the host may drive: it gave the pass-key, or none is set."""
        return self._connection is not None and (self._passkey is None or self._paired)

    def set_info(self, data):
        """Changes what may be read without pairing."""
        self._ble.gatts_write(self._info, data)

    def send_bytes(self, data):
        """Bytes for the host; False where the stack has no room, and they must be kept."""
        return self._notify(self._tx, data)

    def send_event(self, data):
        """A reply or event for the host; False where the stack has no room, and it must be kept."""
        return self._notify(self._event, data)

    def _notify(self, handle, data):
        connection = self._connection
        if connection is None:
            return False
        try:
            self._ble.gatts_notify(connection, handle, data)
        except OSError:
            self.retries += 1
            return False
        return True

    def tick(self):
        """Does what must not be done in an interrupt."""
        if self._advertise_due:
            self._advertise_due = False
            data, response = self._payloads
            self._ble.gap_advertise(_ADVERTISE_US, data, resp_data=response)
        if self._bonds_changed:
            self._bonds_changed = False
            _save_bonds(self._bonds)
        # A stranger who connects and does not pair would keep the owner out.
        if self.connected() and not self.trusted() and ticks_diff(ticks_ms(), self._since) > _PAIRING_MS:
            self._since = ticks_ms()
            self._ble.gap_disconnect(self._connection)

    def _irq(self, event, data):
        if event == _WRITE:
            self._written(data[1])
        elif event == _CONNECT:
            self._connection = data[0]
            self._paired = False
            self.mtu = _DEFAULT_MTU
            self._since = ticks_ms()
        elif event == _DISCONNECT:
            self._connection = None
            self._paired = False
            self._advertise_due = True
            self._on_lost()
        elif event == _MTU:
            self.mtu = min(data[1], MTU)
        elif event == _ENCRYPTION:
            self._paired = bool(data[1] and data[2])
            if self._paired:
                self._tries = 0
        elif event == _PASSKEY:
            self._answer_passkey(data[0], data[1])
        elif event == _GET_SECRET:
            return self._secret(data[0], data[1], data[2])
        elif event == _SET_SECRET:
            return self._keep_secret(data[0], data[1], data[2])
        return None

    def _written(self, handle):
        data = self._ble.gatts_read(handle)
        if handle == self._rx:
            if self.trusted():
                self._on_bytes(data)
            else:
                self.refused += 1
        elif handle == self._command:
            self._on_command(bytes(data))

    def _answer_passkey(self, connection, action):
        self._tries += 1
        if self._passkey is None or action != _SHOW_PASSKEY or self._tries > _TRIES:
            self._ble.gap_disconnect(connection)
        else:
            self._ble.gap_passkey(connection, _SHOW_PASSKEY, int(self._passkey))

    def _secret(self, kind, index, key):
        if self._bonds is None:
            return None
        if key is not None:
            return self._bonds.get((kind, bytes(key)))
        for (other, _), value in self._bonds.items():
            if other == kind:
                if index == 0:
                    return value
                index -= 1
        return None

    def _keep_secret(self, kind, key, value):
        if self._bonds is None:
            return False
        name = (kind, bytes(key))
        if value is not None:
            self._bonds[name] = bytes(value)
        elif name in self._bonds:
            del self._bonds[name]
        else:
            return False
        self._bonds_changed = True
        return True


def _load_bonds():
    try:
        with open(_BONDS) as file:
            return {(kind, unhexlify(key)): unhexlify(value) for kind, key, value in json.load(file)}
    except (OSError, ValueError, TypeError):
        return {}


def _save_bonds(bonds):
    rows = [[kind, hexlify(key).decode(), hexlify(value).decode()] for (kind, key), value in bonds.items()]
    with open(_BONDS, "w") as file:
        json.dump(rows, file)
