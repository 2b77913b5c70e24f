"""hand-eye.toml to hand-eye.json: where a rig's camera is on a robot, how sure, and which views or conventions are wrong.

In: a hand-eye file (views of a target, the robot's log of poses) and a rig.
Out: `HandEyeResult`: the answer with covariance, every view left out in turn, what was left out, and why it passed
    or not; the convention that fits where the stated one does not.
Read: run, views, readings, agreement, sphere, planes, timing, covariance, wording.
"""

from scope.hand_eye.readings import Reading, readings_of
from scope.hand_eye.run import HandEyeResult, hand_eye
from scope.hand_eye.wording import hand_eye_text

__all__ = ["HandEyeResult", "Reading", "hand_eye", "hand_eye_text", "readings_of"]
