"""The robot's physics in MuJoCo Warp, on an NVIDIA GPU: the optional extra ``warp``.

The same model, integrator (Runge-Kutta 4) and time step as on the processor, in float32.

Agreement with ``physics.RolloutPhysics``, measured on Warp's processor device: 256,000 control steps of
hoppers flying, standing and fallen under random actions, each begun in the same state. Positions (m,
rad) differ by 1e-7 in the median and by 1e-6 in 999 of 1,000 steps; velocities (m/s, rad/s) by 5e-7
and 5e-6. Stated tolerance: 5e-6 and 5e-5. Beyond it (11 steps in 100,000, up to 1e-3 and 0.3) the
dynamics themselves jump, as a contact sets in or not: in every such step that was looked at, the
processor's own answer changed as much when its state was moved by 3e-7 (velocities: 1e-6). Errors
grow along a trajectory, as the robot's motion is chaotic:

    after control steps        1        5        25       100
    positions, median          1e-7     2e-7     5e-7     4e-6
    positions, 9 of 10 lanes   3e-7     5e-7     1e-6     1e-5
    velocities, median         3e-7     8e-7     4e-6     2e-5
    velocities, 9 of 10 lanes  9e-7     3e-6     1e-5     9e-5

The one lane in hundreds that a jump has parted goes a way of its own. Rounding the processor's states
to float32 after each step does half of all that, with outliers of the same kind.

A saved state goes on exactly on the processor device. On a GPU it need not: MuJoCo Warp adds a lane's
contacts in the order in which its threads finish (its option ``deterministic`` does not sort them yet).
"""

# Kernels are another language in Python's syntax; the type checker knows no elements of their arrays.
# pyright: reportIndexIssue=false, reportOperatorIssue=false

import mujoco
import numpy as np

from onedemo.errors import UserError

try:
    import mujoco_warp
    import warp as wp
except ImportError as error:
    raise UserError(
        f"rollouts.physics = 'warp' needs another package ({error}): pip install 'onedemo[warp]'"
    ) from None

# Warp greets, and reports every kernel that it compiles or loads, unless told not to.
wp.config.log_level = wp.LOG_WARNING

_LOST = int(
    mujoco_warp.OverflowType.BROADPHASE | mujoco_warp.OverflowType.NARROWPHASE | mujoco_warp.OverflowType.NEFC
)
"""Flags of a lane whose contacts did not find room: its physics is wrong from there on."""


class WarpPhysics:
    """``Physics`` on a GPU (or, for tests, on the processor).

    Args:
        model: The robot.
        frame_skip: Physics steps in a control step.
        num_envs: Lanes.
        device: Warp's name of a device, as "cuda:0"; the first GPU, else the processor, if None.
        room: Contacts and constraint rows that a lane can hold; the most that this robot can have if None.

    Raises:
        UserError: If there is no such device, or MuJoCo Warp cannot simulate the model.
    """

    def __init__(
        self, model: mujoco.MjModel, frame_skip: int, num_envs: int, device: str | None = None,
        *, room: tuple[int, int] | None = None,
    ) -> None:  # fmt: skip
        if model.na:
            raise UserError("the warp physics does not keep what this robot's actuators remember")
        self.device = _device(device)
        self._duration = frame_skip * model.opt.timestep
        self._motors = model.nq + model.nv
        with wp.ScopedDevice(self.device):
            try:
                self._model = mujoco_warp.put_model(model)
            except NotImplementedError as error:
                raise UserError(f"the warp physics cannot simulate this robot: {error}") from None
            self._model.opt.warn_overflow = False  # step() raises instead
            self._room = room or _room(model, self._model.nxn_geom_pair_filtered.numpy())
            contacts, rows = self._room
            self._data = mujoco_warp.make_data(model, nworld=num_envs, nconmax=contacts, njmax=rows)
            # One copy each way per control step; from page-locked memory, where there is a GPU.
            pinned = self.device.is_cuda
            into, out = (num_envs, self._motors + model.nu), (num_envs, self._motors + 1)
            self._into, self._out = wp.zeros(into, dtype=float), wp.zeros(out, dtype=float)
            self._host_into = wp.zeros(into, dtype=float, device="cpu", pinned=pinned)
            self._host_out = wp.zeros(out, dtype=float, device="cpu", pinned=pinned)
            # Hundreds of small kernels: recorded once, a control step is one launch (on the processor
            # 14 times as fast). The run before compiles them, which has no place in a recording.
            self._launch(frame_skip)
            with wp.ScopedCapture(self.device) as capture:
                self._launch(frame_skip)
            assert capture.graph is not None
            self._graph = capture.graph

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """See ``Physics.step``.

        Raises:
            RuntimeError: If a lane has more contacts than room was made for.
        """
        sent = self._host_into.numpy()
        sent[:, : self._motors] = states[:, 1:]
        sent[:, self._motors :] = actions
        wp.copy(self._into, self._host_into)
        wp.capture_launch(self._graph)
        wp.copy(self._host_out, self._out)
        wp.synchronize_device(self.device)
        received = self._host_out.numpy()
        lost = np.flatnonzero(received[:, -1])
        if lost.size:
            contacts, rows = self._room
            raise RuntimeError(
                f"lane {lost[0]} (one of {lost.size}) has more contacts than the warp physics has room for, "
                f"{contacts} a lane with {rows} constraints; use rollouts.physics = 'mujoco'"
            )
        after = np.empty_like(states)
        after[:, 0] = states[:, 0] + self._duration  # kept here: float32 would lose the milliseconds
        after[:, 1:] = received[:, :-1]
        return after

    def close(self) -> None:
        """Frees the device's memory."""
        del self._graph, self._model, self._data, self._into, self._out

    def _launch(self, frame_skip: int) -> None:
        d, lanes = self._data, self._data.nworld
        wp.launch(_put, lanes, inputs=[self._into], outputs=[d.qpos, d.qvel, d.ctrl, d.qacc_warmstart])
        for _ in range(frame_skip):
            mujoco_warp.step(self._model, d)
        wp.launch(_take, lanes, inputs=[d.qpos, d.qvel, d.overflow, _LOST], outputs=[self._out])


def _device(name: str | None) -> wp.Device:
    wp.init()
    if name is None:
        return wp.get_device("cuda:0" if wp.is_cuda_available() else "cpu")
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError):
        there = ", ".join(device.alias for device in wp.get_devices())
        raise UserError(f"there is no device {name!r} for the warp physics; there are: {there}") from None


def _room(model: mujoco.MjModel, pairs: np.ndarray) -> tuple[int, int]:
    """Most contacts and constraint rows that a robot of capsules above a plane can have.

    Warp sets the room aside for every lane and runs its kernels over all of it, so a generous
    guess costs time.
    """
    per_pair = 2  # a capsule touches a plane, or a parallel capsule, in two points
    condim = model.geom_condim[pairs].max(axis=1)
    rows = np.where(condim == 1, 1, 2 * (condim - 1))  # a friction pyramid has two sides per direction
    return per_pair * len(pairs), int(per_pair * rows.sum() + model.jnt_limited.sum())


@wp.kernel(enable_backward=False)
def _put(
    into: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
    warmstart: wp.array2d[float],
):
    lane = wp.tid()
    nq, nv = qpos.shape[1], qvel.shape[1]
    for i in range(nq):
        qpos[lane, i] = into[lane, i]
    for i in range(nv):
        qvel[lane, i] = into[lane, nq + i]
        warmstart[lane, i] = 0.0
    for i in range(ctrl.shape[1]):
        ctrl[lane, i] = into[lane, nq + nv + i]


@wp.kernel(enable_backward=False)
def _take(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    overflow: wp.array[int],
    lost: int,
    out: wp.array2d[float],
):
    lane = wp.tid()
    nq, nv = qpos.shape[1], qvel.shape[1]
    for i in range(nq):
        out[lane, i] = qpos[lane, i]
    for i in range(nv):
        out[lane, nq + i] = qvel[lane, i]
    out[lane, nq + nv] = float(overflow[lane] & lost)
