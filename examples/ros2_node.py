"""A ROS 2 node that predicts lever-ups and watches them: the same functions as `foretrace serve`, for rclpy.

Never run under ROS, which is not installed where foretrace is tested: a test runs it with stand-ins for its modules.
What arrives at foretrace/predict is a body as POST /predict has it, in JSON.
"""

import json

import rclpy
from geometry_msgs.msg import PoseStamped
from pydantic import ValidationError
from rclpy.node import Node
from std_msgs.msg import String

import foretrace as ft
from foretrace.studio.bodies import PredictBody
from foretrace.studio.service import imagine


class ForetraceNode(Node):
    def __init__(self) -> None:
        super().__init__("foretrace")
        self.monitor: ft.Monitor | None = None
        self.start = 0.0
        self.imagined = self.create_publisher(String, "foretrace/imagined", 1)
        self.verdicts = self.create_publisher(String, "foretrace/verdict", 10)
        self.create_subscription(String, "foretrace/predict", self.predict, 1)
        self.create_subscription(PoseStamped, "foretrace/object_pose", self.watch, 50)

    def predict(self, message: String) -> None:
        """Predict a lever-up, and be ready to watch it: its first pose is the moment before the blade moves."""
        try:
            body = PredictBody.model_validate_json(message.data)
            found = imagine(body.object.make(), body.action, body.context)
            self.monitor, self.start = ft.Monitor(found), 0.0
        except (ValidationError, ft.ForetraceError) as error:
            self.get_logger().error(" ".join(str(error).split()))
            return
        answer = {"times": found.times.tolist(), **found.to_dict(body.level, body.most_futures)}
        self.imagined.publish(String(data=json.dumps(answer)))

    def watch(self, message: PoseStamped) -> None:
        """A tracked pose of the object's frame, in the action frame."""
        if self.monitor is None:
            return
        stamp, pose = message.header.stamp, message.pose
        time = stamp.sec + 1e-9 * stamp.nanosec
        self.start = self.start or time
        p, q = pose.position, pose.orientation
        verdict = self.monitor.update(time - self.start, [p.x, p.y, p.z, q.w, q.x, q.y, q.z])
        content = {name: getattr(verdict, name) for name in ("time", "alarm", "score", "cause")}
        self.verdicts.publish(String(data=json.dumps(content)))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(ForetraceNode())
