"""The link to the host: advertising, the two services, and pairing with the pass-key.

A write that arrives before the link is authenticated is discarded, whether the stack refused it or not.
"""

from struct import pack

import bluetooth
from micropython import const
from tagid_bridge import clock
from tagid_bridge.pairing import Pairing

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
_PAIRING_MS = const(60000)


class Radio:
    """One peripheral that serves one host at a time.

    Args:
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
        self._pairing = None if passkey is None else Pairing()
        self._asked = None
        self._answered = False
        self.fault = None
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
        # An attribute holds 20 bytes by default; in append mode two writes before one read lose nothing.
        self._ble.gatts_set_buffer(self._rx, 1024, True)
        self._ble.gatts_set_buffer(self._command, MTU)

    def _advertisement(self, name):
        # Legacy advertising has 31 bytes: flags and service fill 21, so the name goes into the scan response.
        service = bytes(NUS)
        text = name.encode()
        data = b"\x02\x01\x06" + pack("BB", len(service) + 1, 7) + service
        return data, pack("BB", len(text) + 1, 9) + text

    def connected(self):
        return self._connection is not None

    def trusted(self):
        """Whether the host may drive: it used the pass-key with LE Secure Connections, or none is set."""
        if self._connection is None:
            return False
        return self._pairing is None or (self._paired and self._pairing.secure)

    def set_info(self, data):
        """Change the information that can be read without pairing."""
        self._ble.gatts_write(self._info, data)

    def send_bytes(self, data):
        """Send bytes to the host; False if the stack has no room, and the caller must keep them."""
        return self._notify(self._tx, data)

    def send_event(self, data):
        """Send a reply or event to the host; False if the stack has no room, and the caller must keep it."""
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
        """Do the work that must not be done in an interrupt."""
        if self._advertise_due:
            self._advertise_due = False
            data, response = self._payloads
            self._ble.gap_advertise(_ADVERTISE_US, data, resp_data=response)
        if self._pairing is not None:
            self._tend_pairing()
        # A host that connects and does not pair would block the owner.
        if self.connected() and not self.trusted() and clock.ms() - self._since > _PAIRING_MS:
            self._since = clock.ms()
            self._hang_up(self._connection)

    def _tend_pairing(self):
        pairing = self._pairing
        if self._asked is not None:
            connection, action = self._asked
            self._asked = None
            if action != _SHOW_PASSKEY or not pairing.may_try():
                self._hang_up(connection)
            else:
                pairing.begin()
                self._answered = True
                try:
                    self._ble.gap_passkey(connection, _SHOW_PASSKEY, int(self._passkey))
                except OSError:
                    pass  # the peer has disconnected; its attempt is counted
        if pairing.legacy:
            # Legacy pairing can be broken by recording it once; disconnect a host that used it.
            pairing.legacy = False
            self._hang_up(self._connection)
        if self._answered and self.trusted():
            self._answered = False
            pairing.passed()
        pairing.save()

    def _hang_up(self, connection):
        if connection is not None:
            try:
                self._ble.gap_disconnect(connection)
            except OSError:
                pass  # it has already disconnected

    def _irq(self, event, data):
        # MicroPython prints an exception of an interrupt and continues; the loop has to know of it and stop.
        try:
            return self._handle(event, data)
        except Exception as error:
            self.fault = error
            return None

    def _handle(self, event, data):
        if event == _WRITE:
            self._written(data[1])
        elif event == _CONNECT:
            self._connection = data[0]
            self._paired = False
            self._forget_pairing()
            self.mtu = _DEFAULT_MTU
            self._since = clock.ms()
        elif event == _DISCONNECT:
            self._connection = None
            self._paired = False
            self._forget_pairing()
            self._advertise_due = True
            self._on_lost()
        elif event == _MTU:
            self.mtu = min(data[1], MTU)
        elif event == _ENCRYPTION:
            self._paired = bool(data[1] and data[2])
        elif event == _PASSKEY:
            # Answered from the loop, after the attempt is counted in flash.
            self._forget_pairing()
            self._asked = (data[0], data[1])
        elif event == _GET_SECRET and self._pairing is not None:
            return self._pairing.get(data[0], data[1], data[2])
        elif event == _SET_SECRET and self._pairing is not None:
            return self._pairing.put(data[0], data[1], data[2])
        elif event == _SET_SECRET:
            return False
        return None

    def _forget_pairing(self):
        self._asked = None
        self._answered = False
        if self._pairing is not None:
            self._pairing.forget_link()

    def _written(self, handle):
        data = self._ble.gatts_read(handle)
        if handle == self._rx:
            if self.trusted():
                self._on_bytes(data)
            else:
                self.refused += 1
        elif handle == self._command:
            self._on_command(bytes(data))
