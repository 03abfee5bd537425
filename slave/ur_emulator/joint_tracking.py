"""How servoj follows a joint target, and how the joints follow the controller."""

import math
from dataclasses import dataclass
from functools import lru_cache

Joints = tuple[float, ...]
"""One number a joint."""

Transition = tuple[float, float, float, float]
"""`e^{A h}` of a second-order system, row by row."""


@lru_cache(maxsize=64)
def transition(stiffness: float, damping: float, step_s: float) -> Transition:
    """`e^{A h}` of `e'' = -stiffness e - damping e'`, in closed form.

    Args:
        stiffness: In 1/s² (> 0).
        damping: In 1/s (>= 0).
        step_s: h in s.

    Source: any text on linear systems; the test holds it to `scipy.linalg.expm`.
    """
    half = 0.5 * damping
    decay = math.exp(-half * step_s)
    inside = half * half - stiffness
    if abs(inside) * step_s * step_s < 1e-12:
        c, s = 1.0, step_s
    elif inside > 0.0:
        root = math.sqrt(inside)
        c, s = math.cosh(root * step_s), math.sinh(root * step_s) / root
    else:
        root = math.sqrt(-inside)
        c, s = math.cos(root * step_s), math.sin(root * step_s) / root
    return decay * (c + half * s), decay * s, -decay * stiffness * s, decay * (c - half * s)


def servo_step(
    q: Joints,
    qd: Joints,
    target: Joints,
    *,
    lookahead_s: float,
    gain: float,
    max_speed: Joints,
    step_s: float,
) -> tuple[Joints, Joints, Joints]:
    """One step of servoj, exact under a target that is held: position, velocity and mean acceleration at its end.

    `q'' = gain (q_target - q - lookahead q')`, so a target that moves at v is followed by `lookahead v`, at
    `sqrt(gain)` rad/s with a damping ratio of `lookahead sqrt(gain) / 2`. A joint goes no faster than it may.

    Source: second-order model of servoj with the tracking delays that are reported for it (34 ms with a lookahead of
    0.03 s and a gain of 1200 on a UR10e).
    """
    a, b, c, d = transition(gain, gain * lookahead_s, step_s)
    new_q, new_qd = [], []
    for now, rate, goal, most in zip(q, qd, target, max_speed, strict=True):
        error = now - goal
        speed = c * error + d * rate
        if -most <= speed <= most:
            new_q.append(goal + a * error + b * rate)
            new_qd.append(speed)
        else:
            speed = math.copysign(most, speed)
            new_q.append(now + 0.5 * (rate + speed) * step_s)
            new_qd.append(speed)
    qdd = tuple((new - old) / step_s for new, old in zip(new_qd, qd, strict=True))
    return tuple(new_q), tuple(new_qd), qdd


@dataclass(slots=True)
class JointLoop:
    """The joints behind the controller: stiff, damped critically, with motors that saturate.

    With `delta = q - q_target` the loop is `delta'' = u - q_target'' + tau / I`, where
    `u = q_target'' - w² delta - 2 w delta'` is what the motor does and `|I u| <= tau_max`. A joint that has enough
    torque follows exactly and gives way to an external torque by `tau / (I w²)`.

    Args:
        inertia: I of each joint in kg m².
        max_torque: `tau_max` in N m.
        bandwidth: w in rad/s.
    """

    inertia: Joints
    max_torque: Joints
    bandwidth: float
    deflection: Joints = (0.0,) * 6
    rate: Joints = (0.0,) * 6
    saturated: bool = False
    """Whether a motor gave less than was asked of it in the last step."""

    def step(self, target_qdd: Joints, torque: Joints, step_s: float) -> None:
        """Advances by a step in s under an external torque in N m that is held."""
        w = self.bandwidth
        a, b, c, d = transition(w * w, 2.0 * w, step_s)
        deflections, rates = [], []
        self.saturated = False
        for delta, rate, inertia, most, qdd, tau in zip(
            self.deflection, self.rate, self.inertia, self.max_torque, target_qdd, torque, strict=True
        ):
            motor = qdd - w * w * delta - 2.0 * w * rate
            limit = most / inertia
            if -limit <= motor <= limit:
                rest = tau / (inertia * w * w)
                deflections.append(rest + a * (delta - rest) + b * rate)
                rates.append(c * (delta - rest) + d * rate)
                continue
            self.saturated = True
            acceleration = math.copysign(limit, motor) - qdd + tau / inertia
            deflections.append(delta + rate * step_s + 0.5 * acceleration * step_s * step_s)
            rates.append(rate + acceleration * step_s)
        self.deflection, self.rate = tuple(deflections), tuple(rates)

    def rest(self) -> None:
        """Puts it where it was asked to be, at rest."""
        self.deflection = self.rate = (0.0,) * 6
