from __future__ import annotations

from dataclasses import replace

import lone_joint
import numpy as np
import pytest
from lone_joint import INERTIA, MASS_KG, MOTOR, ROD_M, motors
from scipy.integrate import solve_ivp

from failuretwin import load_robot
from failuretwin.core.errors import InputError
from failuretwin.core.movements import stack_movements
from failuretwin.digital_model.nonidealities import Schedule
from failuretwin.digital_model.physics import engine
from failuretwin.digital_model.physics.engine import PhysicsEngine
from failuretwin.digital_model.physics.motors import load_parameters
from failuretwin.digital_model.robot import bundled_robots
from failuretwin.digital_model.twin import Drive
from failuretwin.failure_behavior.random_movements import RandomMovements

mujoco = pytest.importorskip("mujoco")

RAD_PER_COUNT = np.deg2rad(0.24)
WEIGHT = MASS_KG * 9.81
TIME = np.arange(1001) * 0.01


def random_movements(robot, runs, seed=0):
    draws = (np.random.default_rng([seed, run]) for run in range(runs))
    return stack_movements([RandomMovements().draw(robot, Schedule(), rng) for rng in draws])


def ramp_to(target, time, duration=0.5):
    """Return references (run, time, 1) that ramp from zero to each of `target` (run,)."""
    return target[:, None, None] * np.clip(time / duration, 0.0, 1.0)[None, :, None]


def load_torque(robot, angle, payload=0.0):
    """Return the torque that the weight asks of each motor, by MuJoCo's reading of the URDF."""
    model = mujoco.MjModel.from_xml_path(str(robot.urdf_file))
    data = mujoco.MjData(model)
    at = [model.joint(motor.joint).qposadr[0] for motor in robot.motors]
    tool = model.body(robot.profile.tool_link).id
    torque = np.empty_like(angle)
    jacobian = np.zeros((3, model.nv))
    for row in np.ndindex(angle.shape[:-1]):
        data.qpos[at] = angle[row] * robot.sense
        mujoco.mj_forward(model, data)
        mujoco.mj_jacBody(model, data, jacobian, None, tool)
        torque[row] = data.qfrc_bias[at] + payload * 9.81 * jacobian[2, at]
    return torque


def without_friction(parameters):
    return replace(
        parameters, motors=tuple(replace(motor, friction=0.0) for motor in parameters.motors)
    )


def compliance(parameters, weakness=0.0):
    return np.array(
        [
            1.0 / (motor.stiffness * (1.0 - weakness)) + 1.0 / motor.flex_stiffness
            for motor in parameters.motors
        ]
    )


@pytest.fixture(scope="module")
def smooth(armpi):
    """Parameters of the ArmPi without friction."""
    return without_friction(load_parameters(armpi))


@pytest.fixture(scope="module")
def movements(armpi):
    return random_movements(armpi, 6)


@pytest.fixture(scope="module")
def healthy(armpi, movements):
    return PhysicsEngine(armpi).angles(Drive(movements.reference(TIME)), TIME)


def settled(angle):
    """Return angles just before each movement and at the end, (run, movement, motor)."""
    return angle[:, 199::200]


@pytest.mark.parametrize("payload", [0.0, 0.05])
@pytest.mark.parametrize("weakness", [0.0, 0.4])
def test_sag_is_load_times_compliance(armpi, smooth, movements, payload, weakness):
    reference = movements.reference(TIME)
    drive = Drive(
        reference,
        weakness=np.full(reference.shape, weakness),
        payload=np.full(len(reference), payload),
    )

    angle = settled(PhysicsEngine(armpi, smooth).angles(drive, TIME))

    sag = compliance(smooth, weakness) * load_torque(armpi, angle, payload)
    np.testing.assert_allclose(angle, settled(reference) - armpi.sense * sag, rtol=0, atol=1e-4)
    assert np.abs(sag).max() > 0.04


def test_friction_stops_the_drives_short_within_its_band(armpi, healthy, movements):
    parameters = load_parameters(armpi)
    reference = movements.reference(TIME)
    angle = settled(healthy)

    sag = compliance(parameters) * load_torque(armpi, angle)
    off = angle - (settled(reference) - armpi.sense * sag)

    band = np.array([motor.friction / motor.stiffness for motor in parameters.motors])
    assert (np.abs(off) <= band * 1.001).all()
    came_from = np.diff(movements.target, axis=1, prepend=movements.initial[:, None])
    short = (off * np.sign(came_from)).mean(axis=(0, 1))
    assert (short < -0.4 * band).all()


def test_armpi_sags_and_sticks_about_as_the_real_one(armpi):
    """Real figures in counts a metre of lever arm and counts, from its healthy logs."""
    movements = random_movements(armpi, 60, seed=1)
    pose = settled(PhysicsEngine(armpi).angles(Drive(movements.reference(TIME)), TIME))
    error = -(pose - movements.target) / RAD_PER_COUNT
    direction = -np.sign(np.diff(movements.target, axis=1, prepend=movements.initial[:, None]))

    a, b = pose[..., 1], pose[..., 1] - pose[..., 2]
    lever_4 = 0.05071 * np.sin(b + pose[..., 3])
    lever_3 = 0.094714 * np.sin(b) + lever_4
    lever_2 = 0.10048 * np.sin(a) + lever_3
    for k, lever, sag, friction in (
        (1, lever_2, -45.7, -1.01),
        (2, lever_3, 51.5, -2.49),
        (3, lever_4, -59.1, -2.64),
    ):
        terms = np.stack([np.ones(lever.size), lever.ravel(), direction[..., k].ravel()], axis=1)
        fit = np.linalg.lstsq(terms, error[..., k].ravel())[0]
        assert fit[1:] == pytest.approx([sag, friction], rel=0.3)
    assert -np.mean(error[..., 0] * direction[..., 0]) == pytest.approx(1.54, rel=0.3)


@pytest.mark.parametrize("name", bundled_robots())
def test_bundled_arms_come_to_rest_near_their_targets(name):
    robot = load_robot(name)
    reference = random_movements(robot, 4).reference(TIME)

    angle = PhysicsEngine(robot).angles(Drive(reference), TIME)

    assert np.abs(settled(angle) - settled(reference)).max() < np.deg2rad(4.0)
    assert np.abs(settled(angle) - angle[:, 189::200]).max() < np.deg2rad(0.05)
    assert np.abs(angle - reference).max() < np.deg2rad(45.0)


@pytest.mark.parametrize("name", bundled_robots())
def test_arm_starts_at_rest(name):
    robot = load_robot(name)
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    pose = np.random.default_rng(7).uniform(low, high, (5, len(low)))
    time = TIME[:101]
    reference = np.repeat(pose[:, None], len(time), axis=1)
    drive = Drive(
        reference,
        weakness=np.full(reference.shape, 0.3),
        payload=np.full(len(pose), 0.02),
    )

    angle = PhysicsEngine(robot).angles(drive, time)

    np.testing.assert_allclose(angle, angle[:, :1] + 0.0 * angle, rtol=0, atol=1e-9)
    assert np.abs(angle - reference).max() > 1e-3


def test_very_weak_servos_hang_where_the_torques_balance(tmp_path):
    robot = lone_joint.pendulum(tmp_path)
    time = TIME[:11]
    drive = Drive(np.full((1, 11, 1), 0.3), weakness=np.full((1, 11, 1), 0.95))

    angle = PhysicsEngine(robot, motors(MOTOR)).angles(drive, time)[0, -1, 0]

    give = 1.0 / (0.05 * MOTOR.stiffness) + 1.0 / MOTOR.flex_stiffness
    assert angle == pytest.approx(0.3 + give * WEIGHT * ROD_M * np.sin(angle), abs=1e-8)
    assert angle > 1.0


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_weight_pulls_the_same_way_whatever_the_sense_of_the_log(tmp_path, sense):
    robot = lone_joint.pendulum(tmp_path, sense)
    target = np.array([0.8, -0.8])
    time = TIME[:301]

    angle = PhysicsEngine(robot, motors(MOTOR)).angles(Drive(ramp_to(target, time)), time)[:, -1, 0]

    sag = MOTOR.compliance * WEIGHT * ROD_M * np.sin(angle)
    np.testing.assert_allclose(angle, target + sag, atol=1e-6)


def two_masses(time, speed):
    """Return the output side of `MOTOR` on the turntable after the start of a ramp, solved apart.

    Rotor and link with a spring between: without gravity and friction the motor is linear.
    """
    m = MOTOR

    def slope(t, state):
        drive, flex, drive_speed, flex_speed = state
        kept = np.exp(-t / m.filter_s)
        point = speed * (t - m.filter_s * (1.0 - kept))
        point_speed = speed * (1.0 - kept)
        torque = m.stiffness * (point - drive) + m.derivative * (point_speed - drive_speed)
        spring = -m.flex_stiffness * flex - m.flex_damping * flex_speed
        mass = [[INERTIA + m.armature, INERTIA], [INERTIA, INERTIA + m.flex_inertia]]
        return [
            drive_speed,
            flex_speed,
            *np.linalg.solve(mass, [torque - m.damping * drive_speed, spring]),
        ]

    done = solve_ivp(slope, (0.0, time[-1]), np.zeros(4), t_eval=time, rtol=1e-10, atol=1e-12)
    return done.y[0] + done.y[1]


def test_motion_is_that_of_two_masses_and_a_spring(tmp_path):
    robot = lone_joint.turntable(tmp_path)
    time = TIME[:61]
    judge = two_masses(time, speed=2.0)
    errors = []
    for step in (0.005, 0.0025, 0.00125):
        moved = PhysicsEngine(robot, motors(MOTOR), step_s=step).angles(
            Drive(2.0 * time[None, :, None]), time
        )
        errors.append(np.abs(moved[0, :, 0] - judge).max())

    assert errors[0] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.2)


def test_stiff_and_quick_motors_follow_the_reference(tmp_path):
    robot = lone_joint.pendulum(tmp_path)
    stiff = replace(
        MOTOR,
        stiffness=4e4,
        derivative=400.0,
        filter_s=1e-4,
        damping=0.0,
        flex_stiffness=4e4,
        flex_damping=200.0,
        torque_limit=np.inf,
    )
    time = TIME[:201]
    reference = 0.4 * (1.0 - np.cos(3.0 * time))[None, :, None]

    angle = PhysicsEngine(robot, motors(stiff), step_s=2e-4).angles(Drive(reference), time)

    np.testing.assert_allclose(angle, reference, rtol=0, atol=5e-4)


def test_torque_and_back_emf_limit_the_speed(tmp_path):
    """No-load speed of a DC motor: stall torque over back-EMF."""
    robot = lone_joint.turntable(tmp_path)
    feeble = replace(MOTOR, torque_limit=1.0)
    time = TIME[:401]
    reference = np.where(time < 0.1, 0.0, 10.0)[None, :, None]

    angle = PhysicsEngine(robot, motors(feeble)).angles(Drive(reference), time)[0, :, 0]

    no_load = feeble.torque_limit / feeble.damping
    assert np.diff(angle).max() / 0.01 == pytest.approx(no_load, rel=1e-3)


def test_reference_beyond_the_speed_limit_is_chased_at_that_speed(tmp_path):
    robot = lone_joint.turntable(tmp_path)
    time = TIME[:201]
    reference = np.where(time < 0.1, 0.0, 50.0)[None, :, None]

    angle = PhysicsEngine(robot, motors(replace(MOTOR, torque_limit=1e4))).angles(
        Drive(reference), time
    )[0, :, 0]

    speed = np.diff(angle) / 0.01
    np.testing.assert_allclose(speed[100:120], lone_joint.SPEED_LIMIT, rtol=1e-2)


@pytest.fixture(scope="module")
def held_run(armpi):
    """Motor 3 held from 3 s to 7.9 s: its drive, and the same run unharmed."""
    reference = random_movements(armpi, 4, seed=2).reference(TIME)
    held = np.zeros(reference.shape, dtype=bool)
    held[:, 300:790, 2] = True
    angle = PhysicsEngine(armpi).angles(Drive(reference, held=held), TIME)
    return reference, angle


def test_held_gear_stays_where_it_is_and_flexes_under_load(armpi, held_run):
    reference, angle = held_run
    flex = load_parameters(armpi).motors[2].flex_stiffness
    at = [399, 599, 789]
    load = armpi.sense[2] * load_torque(armpi, angle[:, at])[..., 2]

    drive = angle[:, at, 2] + load / flex

    np.testing.assert_allclose(drive, drive[:, :1] + 0.0 * drive, rtol=0, atol=2e-5)
    assert np.ptp(load, axis=1).max() > 0.05
    assert np.abs(reference[:, at, 2] - drive).max() > 0.5


def test_held_gear_does_not_creep(tmp_path):
    robot = lone_joint.pendulum(tmp_path)
    reference = ramp_to(np.array([1.5]), TIME, duration=3.0)
    held = np.zeros(reference.shape, dtype=bool)
    held[:, 100:] = True

    angle = PhysicsEngine(robot, motors(MOTOR)).angles(Drive(reference, held=held), TIME)[0, :, 0]

    assert abs(angle[-1] - angle[300]) < 1e-4
    assert abs(angle[-1] - 0.5) < 0.2


def test_other_motors_and_released_ones_follow(armpi, held_run, healthy):
    reference, angle = held_run
    unharmed = PhysicsEngine(armpi).angles(Drive(reference), TIME)

    np.testing.assert_array_equal(angle[:, :301], unharmed[:, :301])
    band = 2.0 * RAD_PER_COUNT * np.array([1.6, 2.0, 2.8, 2.8])
    assert (np.abs(angle[:, -1] - unharmed[:, -1]) < band).all()
    assert np.abs(angle[:, 599, 3] - reference[:, 599, 3]).max() < np.deg2rad(3.0)


def test_stuck_turntable_holds_its_angle(armpi):
    """Nothing loads motor 1 at rest, so not even its flex moves."""
    reference = random_movements(armpi, 4, seed=3).reference(TIME)
    held = np.zeros(reference.shape, dtype=bool)
    held[:, 350:, 0] = True
    angle = PhysicsEngine(armpi).angles(Drive(reference, held=held), TIME)

    at_rest = angle[:, [399, 599, 799, 999], 0]
    np.testing.assert_allclose(at_rest, at_rest[:, :1] + 0.0 * at_rest, rtol=0, atol=1e-4)


def test_weakness_may_grow_during_a_run(tmp_path):
    robot = lone_joint.pendulum(tmp_path)
    reference = np.full((1, len(TIME), 1), 0.5)
    weakness = np.linspace(0.0, 0.6, len(TIME))[None, :, None]

    angle = PhysicsEngine(robot, motors(MOTOR)).angles(Drive(reference, weakness=weakness), TIME)

    give = 1.0 / (MOTOR.stiffness * (1.0 - weakness)) + 1.0 / MOTOR.flex_stiffness
    balanced = 0.5 + give * WEIGHT * ROD_M * np.sin(angle)
    np.testing.assert_allclose(angle, balanced, atol=3e-3)
    assert angle[0, -1, 0] - angle[0, 0, 0] > 0.03


@pytest.mark.parametrize("name", bundled_robots())
def test_rough_treatment_is_survived(name):
    """Gears that catch and let go, servos that fail in a moment, jumps, a heavy load."""
    robot = load_robot(name)
    reference = random_movements(robot, 8, seed=5).reference(TIME)
    reference[4:, 450:] *= -0.5
    rng = np.random.default_rng(9)
    held = np.repeat(rng.random((8, 91, len(robot.motors))) < 0.1, 11, axis=1)
    weakness = np.where(np.repeat(rng.random((8, 13, len(robot.motors))) < 0.2, 77, axis=1), 0.8, 0)
    drive = Drive(reference, held, weakness, payload=rng.uniform(0.0, 0.2, 8))

    angle = PhysicsEngine(robot).angles(drive, TIME)

    assert np.abs(angle).max() < np.abs(reference).max() + 1.0


def test_bytes_depend_on_neither_threads_nor_chunks_nor_neighbours(armpi, monkeypatch):
    reference = random_movements(armpi, 5, seed=4).reference(TIME)
    reference[3, 500:] += 0.5  # a jump, so that this run meets the speed limit
    rng = np.random.default_rng(8)
    held = rng.random(reference.shape) < 0.001
    drive = Drive(reference, held, 0.3 * rng.random(reference.shape), payload=rng.random(5) / 20.0)
    whole = PhysicsEngine(armpi).angles(drive, TIME)

    np.testing.assert_array_equal(PhysicsEngine(armpi, threads=3).angles(drive, TIME), whole)
    alone = Drive(reference[1:2], held[1:2], drive.weakness[1:2], payload=drive.payload[1:2])
    np.testing.assert_array_equal(PhysicsEngine(armpi).angles(alone, TIME), whole[1:2])
    monkeypatch.setattr(engine, "RUNS_AT_ONCE", 2)
    monkeypatch.setattr(engine, "SAMPLES_AT_ONCE", 37)
    np.testing.assert_array_equal(PhysicsEngine(armpi).angles(drive, TIME), whole)


def test_nothing_that_hampers_changes_nothing(armpi, healthy, movements):
    reference = movements.reference(TIME)
    nothing = Drive(
        reference,
        held=np.zeros(reference.shape, dtype=bool),
        weakness=np.zeros(reference.shape),
        compliance=np.ones((len(reference), 4)),
        payload=np.zeros(len(reference)),
    )
    np.testing.assert_array_equal(PhysicsEngine(armpi).angles(nothing, TIME), healthy)


def test_error_of_the_step_is_below_a_quarter_of_a_count(armpi, healthy, movements):
    fine = PhysicsEngine(armpi, step_s=engine.STEP_S / 10.0).angles(
        Drive(movements.reference(TIME)), TIME
    )
    assert 0.0 < np.abs(healthy - fine).max() < 0.25 * RAD_PER_COUNT


def test_inputs_stay_as_they_were(armpi, movements):
    reference = movements.reference(TIME)
    before = reference.copy()
    PhysicsEngine(armpi).angles(Drive(reference), TIME)
    np.testing.assert_array_equal(reference, before)


def test_no_runs_give_no_angles(armpi):
    assert PhysicsEngine(armpi).angles(Drive(np.zeros((0, 11, 4))), TIME[:11]).shape == (0, 11, 4)


def test_too_long_a_step_is_refused(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log file where it is
    robot = lone_joint.pendulum(tmp_path)
    time = np.arange(200) * 0.05
    with pytest.raises(InputError, match="unstable at a step of 0\\.05 s"):
        PhysicsEngine(robot, motors(MOTOR), step_s=0.05).angles(
            Drive(ramp_to(np.ones(1), time)), time
        )
    assert "unstable" in "".join(capfd.readouterr())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": np.zeros((2, 10, 4))}, "(2, 10, 4), expected (run, 11 times, 4 motors)"),
        ({"reference": np.full((2, 11, 4), np.nan)}, "not finite"),
        ({"held": np.zeros((2, 11), dtype=bool)}, "`held` has shape (2, 11), expected (2, 11, 4)"),
        ({"weakness": np.ones((2, 11, 4))}, "`weakness` must lie between 0 and 0.99"),
        ({"payload": -np.ones(2)}, "`payload` must lie between 0 and inf"),
    ],
)
def test_impossible_drives_are_refused(armpi, change, message):
    drive = replace(Drive(np.zeros((2, 11, 4))), **change)
    with pytest.raises(InputError) as error:
        PhysicsEngine(armpi).angles(drive, TIME[:11])
    assert message in str(error.value)


@pytest.mark.parametrize("time", [np.zeros(1), np.array([0.0, 0.1, 0.3])])
def test_grids_that_are_not_uniform_are_refused(armpi, time):
    with pytest.raises(InputError, match="not a uniform, increasing grid"):
        PhysicsEngine(armpi).angles(Drive(np.zeros((1, len(time), 4))), time)


@pytest.mark.parametrize("change", [{"threads": 0}, {"step_s": 0.0}])
def test_impossible_engines_are_refused(armpi, change):
    with pytest.raises(InputError, match=next(iter(change))):
        PhysicsEngine(armpi, **change)
