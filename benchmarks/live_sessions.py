"""Real sessions as ROS 1 bags, replayed through ROS topics: the same diagnosis as from the files?

Start `roscore` first. Argument: the folder of `real_robot_b_20241003`. One session of each of the
labels 0 and 5 to 8 is written as a bag of the authors' messages, replayed through a real roscore,
and what comes back is cut into runs at the command rows.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from failuretwin import BayesDiagnoser, DigitalTwin, load_robot
from failuretwin.app.shadow import Shadow
from failuretwin.connection.links.base import CommandSent, Event, Reading
from failuretwin.connection.links.replay import (
    AS_FAST_AS_POSSIBLE,
    Pace,
    PacedSource,
    replay,
    session_events,
)
from failuretwin.connection.links.ros_link import RosSink, RosSource, open_transport
from failuretwin.connection.links.ros_messages import RosTopics, RosWriter
from failuretwin.connection.links.ros_transport import RosCodec
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.bag_messages import NS_PER_S
from failuretwin.data_knowledge.readers.raw_sessions import (
    RawSession,
    read_session,
    session_runs,
    split_session,
)
from failuretwin.decision.streaming.diagnoser import StreamingDiagnoser
from failuretwin.digital_model.robot import Robot

LABELS = (0, 5, 6, 7, 8)
SPEED = 40.0
"""Replay speed; 400 readings a second."""
QUIET_S = 3.0
"""After such a silence all messages have come [s]."""


def write_bag(path: Path, events: list[Event], robot: Robot) -> None:
    """Write events as a ROS 1 bag of the authors' messages."""
    from rosbags.rosbag1 import Writer

    codec, writer, topics = RosCodec(1), RosWriter(robot, RosTopics()), RosTopics()
    definition, md5 = codec.definition(topics.command_type)
    type_ = codec.full_name(topics.command_type)
    with Writer(path) as bag:
        connections = {
            name: bag.add_connection(f"/{name}", type_, msgdef=definition, md5sum=md5)
            for name, _ in writer.topics
        }
        for event in events:
            for message in writer.messages(event):
                stamp = round(event.time * NS_PER_S)
                bag.write(connections[message.topic], stamp, codec.encode(message))


def through_ros(events: PacedSource, robot: Robot) -> list[Event]:
    """Return what comes back of events that are published on a real ROS network."""
    topics, back = RosTopics(), []
    with open_transport("ros1") as transport:
        source = RosSource(robot, topics, transport)
        sink = RosSink(RosWriter(robot, topics), transport)
        while source.poll(0.2) is None:  # until the two know each other
            sink.put(CommandSent(0.0, np.zeros(len(robot.motors)), np.ones(len(robot.motors))))
            sink.put(Reading(1.0, np.full(3, np.nan), np.zeros(len(robot.motors))))
        while source.poll(QUIET_S) is not None:
            pass
        while not events.ended:
            event = events.poll(0.01)
            if event is not None:
                sink.put(event)
            while (come := source.poll(0.0)) is not None:
                back.append(come)
        while (come := source.poll(QUIET_S)) is not None:
            back.append(come)
    return back


def as_session(events: list[Event], like: RawSession, robot: Robot) -> RawSession:
    """Return events as a session; readings without a value are out of the servo's range again."""
    commands = [e for e in events if isinstance(e, CommandSent)]
    readings = [e for e in events if isinstance(e, Reading)]

    def counts(rows: list[FloatArray]) -> FloatArray:
        found = np.round(robot.servo_units.to_counts(np.array(rows)))
        return np.where(np.isfinite(found), found, -1.0)

    zero = like.command_time[0] - commands[0].time
    return replace(
        like,
        command_time=np.array([c.time for c in commands]) + zero,
        target_counts=counts([c.target for c in commands]),
        ramp_s=np.array([c.duration for c in commands]),
        reading_time=np.array([r.time for r in readings]) + zero,
        reading_counts=counts([r.position for r in readings if r.position is not None]),
    )


def stream_answers(session: RawSession, robot: Robot) -> list[str | None]:
    """Return the last answer of the stream in each run, cut at the command rows."""
    twin, found = DigitalTwin(robot), []
    for span in split_session(session, robot):
        begin = session.command_time[span.start] - 0.5
        end = np.append(session.command_time, np.inf)[span.stop]
        events = list(session_events(session, robot))
        # Where the arm was told to stand before the run is known from the command before it.
        before = [e for e in events if isinstance(e, CommandSent) and e.time < begin][-1:]
        inside = [e for e in events if begin <= e.time < end]
        source = PacedSource("run", iter([*before, *inside]), Pace(AS_FAST_AS_POSSIBLE))
        shadow = Shadow(source, StreamingDiagnoser(BayesDiagnoser(twin)), twin)
        while shadow.step(0.0):
            pass
        diagnosis = shadow.snapshot.answer.diagnosis
        found.append(None if diagnosis is None else diagnosis.diagnosis)
    return found


def main() -> None:
    """Print a line for each session."""
    robot = load_robot("armpi_fpv")
    diagnoser = BayesDiagnoser(DigitalTwin(robot))
    for label in LABELS:
        folder = min(p for p in Path(sys.argv[1], f"label_{label}").iterdir() if p.is_dir())
        session = read_session(folder, robot)
        with tempfile.TemporaryDirectory() as place:
            bag = Path(place) / "session.bag"
            write_bag(bag, list(session_events(session, robot)), robot)
            events = through_ros(replay(bag, robot, Pace(SPEED)), robot)
        live = as_session(events, session, robot)
        batch = diagnoser.diagnose(session_runs(session, robot, "measured"))
        again = diagnoser.diagnose(session_runs(live, robot, "measured"))
        stream = stream_answers(live, robot)
        same = sum(a.diagnosis == b.diagnosis for a, b in zip(batch, again, strict=True))
        off = max(
            abs(a.posterior[name] - b.posterior[name])
            for a, b in zip(batch, again, strict=True)
            for name in a.posterior
        )
        streamed = sum(a.diagnosis == b for a, b in zip(batch, stream, strict=True))
        print(
            f"label {label}: {len(live.reading_time)} of {len(session.reading_time)} readings and "
            f"{len(live.command_time)} of {len(session.command_time)} commands came; {same} of "
            f"{len(batch)} runs the same, posteriors within {off:.1e}; {streamed} of {len(batch)} "
            "the same from the stream"
        )


if __name__ == "__main__":
    main()
