"""A ROS 2 node on DDS, played by CycloneDDS: names, types and what announces it."""

import dataclasses
import functools
import types

import robot as rb
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.builtin import BuiltinTopicDcpsSubscription
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, annotations
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

# Plain CDR, as ROS 2 writes it.
PLAIN = Policy.DataRepresentation(use_cdrv0_representation=True)
RELIABLE = Policy.Reliability.Reliable(duration(seconds=10))
SENSOR = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(5), PLAIN)
DEFAULT = Qos(RELIABLE, Policy.History.KeepLast(10), PLAIN)
LATCHED = Qos(RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1), PLAIN)


def struct(kind, fields):
    """A struct with the name that ROS 2 gives a type on DDS."""
    package, group, name = kind.split("/")
    annotated = {"__annotations__": dict(fields), "__module__": __name__}
    typename = f"{package}.{group}.dds_.{name}_"
    made = types.new_class(name, (IdlStruct,), {"typename": typename}, lambda body: body.update(annotated))
    return dataclasses.dataclass(annotations.final(made))


@functools.cache
def message(kind):
    """The struct of a message, by its definition."""
    return struct(kind, [(name, field(*node)) for name, node in rb.ROS.fielddefs[kind][1]])


def field(node, detail):
    if node == Nodetype.BASE:
        return str if detail[0] == "string" else getattr(idl, detail[0])
    if node == Nodetype.NAME:
        return message(detail)
    element, length = field(*detail[0]), detail[1]
    return idl.array[element, length] if node == Nodetype.ARRAY else idl.sequence[element]


# What a request and its reply begin with, so that they find each other.
IDENTITY = [("client", idl.uint64), ("number", idl.int64)]
GID = struct("rmw_dds_common/msg/Gid", [("data", idl.array[idl.uint8, 16])])
NODE = struct(
    "rmw_dds_common/msg/NodeEntitiesInfo",
    [
        ("node_namespace", str),
        ("node_name", str),
        ("reader_gid_seq", idl.sequence[GID]),
        ("writer_gid_seq", idl.sequence[GID]),
    ],
)
PARTICIPANT = struct(
    "rmw_dds_common/msg/ParticipantEntitiesInfo",
    [("gid", GID), ("node_entities_info_seq", idl.sequence[NODE])],
)


class Publisher:
    def __init__(self, writer, kind):
        self.writer, self.kind = writer, kind

    def publish(self, message_fields):
        self.writer.write(message(self.kind).deserialize(rb.to_cdr(self.kind, message_fields)))

    def is_matched(self):
        return len(self.writer.get_matched_subscriptions()) > 0


class Subscription:
    def __init__(self, reader, kind):
        self.reader, self.kind = reader, kind

    def take(self):
        """The messages that have come."""
        taken = self.reader.take(N=100)
        samples = [sample for sample in taken if sample.sample_info.valid_data]
        return [rb.from_cdr(self.kind, sample.serialize(use_version_2=False)) for sample in samples]


class GetMap:
    """A client of nav_msgs/srv/GetMap."""

    KIND = "nav_msgs/srv/GetMap"

    def __init__(self, node, name):
        request = struct(f"{self.KIND}_Request", [*IDENTITY, ("nothing", idl.uint8)])
        grid = message("nav_msgs/msg/OccupancyGrid")
        response = struct(f"{self.KIND}_Response", [*IDENTITY, ("map", grid)])
        self.requests = node.writer(f"rq{name}Request", request, DEFAULT)
        self.replies = node.reader(f"rr{name}Reply", response, DEFAULT)
        self.request, self.number = request, 0

    def is_matched(self):
        return self.requests.get_matched_subscriptions() and self.replies.get_matched_publications()

    def ask(self):
        self.number += 1
        self.requests.write(self.request(0x1122334455667788, self.number, 0))

    def take(self):
        """The map of the reply to the last request, as a message; nothing while none has come."""
        for sample in self.replies.take(N=10):
            if sample.sample_info.valid_data and sample.number == self.number:
                assert sample.client == 0x1122334455667788
                kind = "nav_msgs/msg/OccupancyGrid"
                return [rb.from_cdr(kind, sample.map.serialize(use_version_2=False))]
        return []


class Node:
    """A ROS 2 node of Jazzy, without namespace."""

    def __init__(self, domain, name):
        self.participant, self.name = DomainParticipant(domain), name
        self.readers, self.writers = [], []
        self.announcements = DataWriter(
            self.participant, Topic(self.participant, "ros_discovery_info", PARTICIPANT), qos=LATCHED
        )

    def publisher(self, name, kind, qos=DEFAULT):
        return Publisher(self.writer(f"rt{name}", message(kind), qos), kind)

    def subscription(self, name, kind, qos=DEFAULT):
        return Subscription(self.reader(f"rt{name}", message(kind), qos), kind)

    def writer(self, name, of, qos):
        self.writers.append(DataWriter(self.participant, Topic(self.participant, name, of), qos=qos))
        self.announce()
        return self.writers[-1]

    def reader(self, name, of, qos):
        self.readers.append(DataReader(self.participant, Topic(self.participant, name, of), qos=qos))
        self.announce()
        return self.readers[-1]

    def announce(self):
        """Bridges pass over endpoints that no node tells to be its own."""

        def gid(entity):
            return GID(list(entity.guid.bytes))

        node = NODE("/", self.name, list(map(gid, self.readers)), list(map(gid, self.writers)))
        self.announcements.write(PARTICIPANT(gid(self.participant), [node]))

    def listed(self, builtin):
        """Names and types of what others have, as `ros2 topic list` finds them."""
        reader = BuiltinDataReader(self.participant, builtin)
        own = {writer.guid for writer in self.writers} | {reader.guid for reader in self.readers}
        return {(end.topic_name, end.type_name) for end in reader.take(N=200) if end.key not in own}

    def written_by_others(self):
        return self.listed(BuiltinTopicDcpsPublication)

    def read_by_others(self):
        return self.listed(BuiltinTopicDcpsSubscription)
