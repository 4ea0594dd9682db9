"""The radio link between two virtual controllers: the bridge's, and one for each host that connects over TCP.

Unlike a real link it can be cut at a chosen time; like on a real link, each side detects that only after
its supervision timeout.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from functools import partial
from typing import Any

from bumble import hci, ll
from bumble.controller import Controller
from bumble.core import PhysicalTransport
from bumble.link import LocalLink
from bumble.transport.common import StreamPacketSink, StreamPacketSource

COMMAND_TIMEOUT_S = 120.0
"""A virtual controller answers at once, but its process may not run for seconds on a busy computer."""
_DATA_LENGTH = 251
"""Bytes of an LE data packet with the length extension, as on ESP32 and current computers."""
_READ_BYTES = 65536


class Air(LocalLink):
    """A link that can be cut.

    Args:
        interval_s: time between connection events, s; limits the bridge's notification rate.
        supervision_s: silence after which a side considers the link lost, s.
    """

    def __init__(self, interval_s: float, supervision_s: float) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.interval_s = interval_s
        self.supervision_s = supervision_s
        self.is_cut = False
        self._responses: dict[str, bytes] = {}

    def set_scan_response(self, address: hci.Address, data: bytes) -> None:
        """Virtual controllers answer scans with the advertisement alone; this adds the scan response."""
        self._responses[str(address)] = data

    def send_advertising_pdu(self, sender_controller: Controller, packet: ll.AdvertisingPdu) -> None:
        if self.is_cut:
            return
        if isinstance(packet, (ll.AdvInd, ll.AdvExtInd)):
            more = self._responses.get(str(packet.advertiser_address), b"")
            packet = dataclasses.replace(packet, data=packet.data + more)
        super().send_advertising_pdu(sender_controller, packet)

    def send_acl_data(
        self,
        sender_controller: Controller,
        destination_address: hci.Address,
        transport: PhysicalTransport,
        data: bytes,
    ) -> None:
        if not self.is_cut:
            super().send_acl_data(sender_controller, destination_address, transport, data)

    def send_ll_control_pdu(
        self, sender_address: hci.Address, receiver_address: hci.Address, packet: ll.ControlPdu
    ) -> None:
        if not self.is_cut and self.find_le_controller(receiver_address) is not None:
            super().send_ll_control_pdu(sender_address, receiver_address, packet)

    def cut(self) -> None:
        """Block all packets; after the supervision timeout both sides are notified and packets pass again."""
        if self.is_cut:
            return
        self.is_cut = True
        asyncio.get_running_loop().call_later(self.supervision_s, self._timed_out)

    def _timed_out(self) -> None:
        for controller in list(self.controllers):
            lose_links(controller)
        self.is_cut = False


def lose_links(controller: Controller) -> None:
    """Report the loss of all connections of a controller, with the cause supervision timeout."""
    for connection in list(controller.le_connections.values()):
        controller.on_le_disconnected(connection, hci.HCI_ErrorCode.CONNECTION_TIMEOUT_ERROR)


def make_controller(name: str, air: Air, **ends: Any) -> Controller:
    """A controller on the virtual link with the usual packet length."""
    controller = Controller(name, link=air, **ends)
    controller.le_acl_data_packet_length = _DATA_LENGTH
    controller.supported_max_tx_octets = controller.supported_max_rx_octets = _DATA_LENGTH
    return controller


class HciServer:
    """Gives every host that connects over TCP its own controller, removed when the host disconnects."""

    def __init__(self, air: Air, bridge: Controller) -> None:
        self._air = air
        self._bridge = bridge
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()

    async def start(self, host: str, port: int) -> int:
        """Start listening; return the port."""
        self._server = await asyncio.start_server(self._serve, host, port)
        return int(self._server.sockets[0].getsockname()[1])

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
            for writer in self._writers:
                writer.transport.abort()
            await self._server.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        source, sink = StreamPacketSource(), StreamPacketSink(writer.transport)
        controller = make_controller("host", self._air, host_source=source, host_sink=sink)
        self._writers.add(writer)
        try:
            with contextlib.suppress(ConnectionError):
                while data := await reader.read(_READ_BYTES):
                    source.data_received(data)
        finally:
            self._writers.discard(writer)
            writer.close()
            with contextlib.suppress(KeyError):
                self._air.remove_controller(controller)
            if controller.le_connections:
                # The host's process has ended, perhaps killed: the bridge detects it only by silence.
                later = partial(lose_links, self._bridge)
                asyncio.get_running_loop().call_later(self._air.supervision_s, later)
