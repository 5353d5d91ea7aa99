"""Another ROS 1 program, on Debian's own interpreter and rospy: publishes and listens.

Run as a script it takes one JSON object a line and answers each with one. In tests, `RosPeer`
speaks to it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time


class RosPeer:
    """Handle of such a program.

    Args:
        environment: Its environment, with the address of the master.
    """

    def __init__(self, environment) -> None:
        self._process = subprocess.Popen(
            ["/usr/bin/python3", __file__],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, **call):
        """Send a call and return the answer."""
        self._process.stdin.write(json.dumps(call) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self):
        self._process.stdin.close()
        self._process.wait(20)
        self._process.stdout.close()


def _main():
    import genpy
    import genpy.dynamic
    import rospy
    from genpy.message import fill_message_args

    rospy.init_node("peer", anonymous=True, disable_signals=True)
    classes, publishers, heard = {}, {}, {}

    def class_of(call):
        if "definition" in call:
            return genpy.dynamic.generate_dynamic(call["type"], call["definition"])[call["type"]]
        import roslib.message

        return roslib.message.get_message_class(call["type"])

    def take(message, topic):
        stamp = message.header.stamp.to_sec()
        statuses = [
            {"name": s.name, "level": s.level, "message": s.message, "hardware": s.hardware_id}
            | {"values": {v.key: v.value for v in s.values}}
            for s in message.status
        ]
        heard[topic].append({"stamp": stamp, "statuses": statuses})

    def advertise(call):
        topic, classes[topic] = call["topic"], class_of(call)
        publishers[topic] = rospy.Publisher(topic, classes[topic], queue_size=1000)
        deadline = time.time() + call["wait_s"]
        while not publishers[topic].get_num_connections() and time.time() < deadline:
            time.sleep(0.02)
        return {"md5": classes[topic]._md5sum, "heard": publishers[topic].get_num_connections()}

    def publish(call):
        message = classes[call["topic"]]()
        fill_message_args(message, [call["content"]])
        publishers[call["topic"]].publish(message)
        return {}

    def listen(call):
        import roslib.message

        heard[call["topic"]] = []
        class_ = roslib.message.get_message_class(call["type"])
        rospy.Subscriber(call["topic"], class_, take, call["topic"])
        return {}

    calls = {
        "advertise": advertise,
        "publish": publish,
        "listen": listen,
        "heard": lambda call: heard[call["topic"]],
    }
    for line in sys.stdin:
        call = json.loads(line)
        print(json.dumps(calls[call["op"]](call)), flush=True)
    rospy.signal_shutdown("done")


if __name__ == "__main__":
    _main()
