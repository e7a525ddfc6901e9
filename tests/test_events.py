"""Laws of a node whose topics are closed while their events wait: it stays up, and tells of events all the same."""

from tests.bus import end, start

NODE = """
import sys, threading, time
import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from stmpl_ros.events import Events, PolledEvents
from stmpl_ros.ticks import steady_timer

rclpy.init()
node, other = (Node if "bare" in sys.argv else PolledEvents)("one"), rclpy.create_node("other")
said, heard, turns, executor = [], [], [], EventsExecutor()
events = Events(lambda kind, line: said.append(line))

def meets(matched):
    until = time.monotonic() + 20
    while not matched() and time.monotonic() < until:
        time.sleep(0.01)
    time.sleep(0.05)

def turn():  # a tool comes; and, while one callback of the node is served, its sender too, and both go
    turns.append(f"tools/tool{len(turns) // 2}/pose")
    if len(turns) % 2:
        return heard.append(events.subscribe(node, String, turns[-1], print, QoSProfile(depth=1)))
    sent = other.create_publisher(String, turns[-1], 1)
    meets(lambda: sent.get_subscription_count())
    node.destroy_subscription(heard.pop())
    other.destroy_publisher(sent)
    time.sleep(0.05)

def kept():  # a topic that stays, whose sender goes
    events.subscribe(node, String, "tools/stays/pose", print, QoSProfile(depth=1))
    sent = other.create_publisher(String, "tools/stays/pose", 1)
    meets(lambda: sent.get_subscription_count())
    other.destroy_publisher(sent)

threading.Thread(target=kept).start()
steady_timer(node, 0.05, turn)
executor.add_node(node)
until = time.monotonic() + 60
while time.monotonic() < until and not (len(turns) > 12 and "tools/stays/pose: the sender is gone" in said):
    executor.spin_once(timeout_sec=0.1)
print(f"{len(turns) > 12} {said}")
"""


def test_topics_are_closed_while_their_events_wait() -> None:
    code, said = end(start("-c", NODE))
    assert code == 0 and "True" in said and "tools/stays/pose: the sender is gone" in said, said
