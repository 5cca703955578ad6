"""simcan: a CAN bus that behaves like CAN, as a python-can interface, on a machine that has none.

::

    with can.Bus(interface="simcan", channel="car", bitrate=500_000) as bus:
        bus.send(can.Message(arbitration_id=0x57A, data=bytes(8), is_extended_id=False))

Arbitration, frame times with stuff bits, acknowledgement, errors and bus-off come from the model that the bench runs on
(bridge/native/can_bus.h). All buses of one channel name in a process are nodes of one wire.
"""

from bridge.simcan.channel import Channel, Disturbance, Node, find_channel
from bridge.simcan.interface import SimCanBus

__all__ = ["Channel", "Disturbance", "Node", "SimCanBus", "find_channel"]
