"""Faults that tests must notice: each is put into a copy of the package.

    python tests/mutants.py [NAME ...] [--frozen FILE]

prints for each fault whether what must notice it does. All checks must pass without a
fault first. Those with the name of a group of `benchmarks.frozen` compare it with FILE,
which is written from the unchanged package if it is not given.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
COPIED = "fdof_jax", "tests", "benchmarks", "pyproject.toml"


class Mutant(NamedTuple):
    """A text of a file, found once, what takes its place, and what must notice.

    - `check`: a test, or a group of `benchmarks.frozen`.
    """

    file: str
    old: str
    new: str
    check: str


BRIEF, SWITCHES = "tests/test_brief_switches.py", "tests/test_switches.py"
HOLDING, CONDITIONS = "tests/test_holding.py", "tests/test_conditions.py"
HYBRID = "tests/test_hybrid_dynamics.py"
ON_TABLE = f"{HYBRID}::test_a_load_on_a_table"
SEVERAL = "tests/test_holding_of_several.py"
MASSES = "tests/test_changing_masses.py"
KINKS = f"{SWITCHES}::test_kinks_of_high_gains_are_exact_in_derivatives"
SAMPLED = "tests/test_sampled_control.py"
CLOSED_FORMS = f"{CONDITIONS}::test_times_and_states_are_closed_forms"
COINCIDENT = (
    f"{SWITCHES}"
    "::test_each_of_coincident_switches_has_its_own_jump_and_is_said_to_coincide"
)
INSTANT = "tests/test_instants.py::test_what_an_instant_cannot_know_is_refused"
EVER_FASTER = (
    f"{CONDITIONS}::test_jumps_that_follow_each_other_ever_faster_are_named[0.1]"
)
ONE_JOINT = f"{HOLDING}::test_one_joint_moves_as_closed_forms_say"
BOUNCES = f"{ONE_JOINT}[a ball bounces to rest]"
BATCHED = "tests/test_batched_rules.py"
ENDS_MOVED = f"{BATCHED}::test_ends_that_only_the_condition_moves"
READING = "tests/mjcf/test_mjcf_reading.py"
FIRST_ENDS = f"{CONDITIONS}::test_the_first_of_several_ends_it"
REFUSALS, STORE = "tests/test_refusals.py", "tests/test_sweep_store.py"

MUTANTS = {
    # Steps that end at switches and known times
    "no retry over a switch": Mutant(
        "steps/landing.py",
        "passed = (within | at_once) & ~arrived",
        "passed = jnp.zeros_like(arrived)",
        KINKS,
    ),
    "no retry for a hidden zero": Mutant(
        "steps/landing.py",
        "unsure = ~passed & (found.unseen < end)",
        "unsure = jnp.zeros_like(passed)",
        f"{BRIEF}::test_no_bumper_is_passed_over",
    ),
    "gap off": Mutant(
        "steps/landing.py",
        "gap = jnp.where(reached, jump + self.apart - place, 0)",
        "gap = jnp.zeros_like(place)",
        f"{HOLDING}::test_reactions_count_a_payload_while_it_is_there",
    ),
    "a known time has no derivative": Mutant(
        "steps/landing.py",
        "end = known[index] - (jump - place)",
        "end = place",
        "holding elements",
    ),
    "chatter goes on": Mutant(
        "steps/landing.py",
        "chatter = (crossings > _MOST_CROSSINGS)",
        "chatter = (crossings < 0)",
        f"{SWITCHES}::test_chatter_is_named_and_spoils_no_other_member",
    ),
    # Zeros
    "no turn between samples": Mutant(
        "steps/zeros.py",
        "turning = (-fall > least[None]) & (rise > least[None])",
        "turning = jnp.zeros_like(fall, bool)",
        f"{SWITCHES}::test_zeros_of_cubic_polynomials",
    ),
    "polynomials are trusted": Mutant(
        "steps/zeros.py",
        "_ELSEWHERE = 12",
        "_ELSEWHERE = 0",
        f"{BRIEF}::test_no_bumper_is_passed_over",
    ),
    "no Newton step in a bracket": Mutant(
        "steps/zeros.py",
        "_ITERATIONS = 6",
        "_ITERATIONS = 0",
        f"{SWITCHES}::test_zeros_of_cubic_polynomials",
    ),
    # What switches
    "sides stay": Mutant(
        "steps/events.py",
        "after = jnp.where(passed.switched, -sides, sides)",
        "after = sides",
        KINKS,
    ),
    "grazing is not counted": Mutant(
        "steps/events.py",
        "grazing=jnp.maximum(passed.missed, regime.grazing),",
        "grazing=passed.missed,",
        f"{SWITCHES}::test_what_turns_back_just_before_or_beyond_its_zero_is_seen",
    ),
    "one-sided places are not counted": Mutant(
        "steps/events.py",
        "return jnp.maximum(last.one_sided, at_once) + together",
        "return last.one_sided",
        COINCIDENT,
    ),
    "coincident switches are one": Mutant(
        "steps/events.py",
        "if any(self.jumping) and before.size > 1:",
        "if False:",
        COINCIDENT,
    ),
    "not moved back after an event": Mutant(
        "steps/events.py",
        "there = moved(-late, end, there, after, self.term)",
        "pass",
        f"{HOLDING}::test_a_batch_has_the_derivatives_of_closed_forms",
    ),
    "held joints drift": Mutant(
        "steps/loop.py",
        "y1 = events.held_still(regime, y1, y0)",
        "pass",
        f"{SEVERAL}::test_a_brake_holds_to_the_last_bit",
    ),
    # Derivatives at switches
    "wrong sign of the lateness": Mutant(
        "steps/switch_derivatives.py",
        "late = -of_zero(zero,",
        "late = of_zero(zero,",
        "holding elements",
    ),
    "one Newton step": Mutant(
        "steps/switch_derivatives.py",
        "for _ in range(2):",
        "for _ in range(1):",
        "switching, twice",
    ),
    "moved to first order": Mutant(
        "steps/switch_derivatives.py",
        "middle = _straight(late / 2, y, term.vf(t, y, args))",
        "middle = y",
        f"{HOLDING}"
        "::test_second_derivatives_of_slides_that_bounce_off_a_stop_and_come_to_rest",
    ),
    "products alike for all members": Mutant(
        "steps/switch_derivatives.py",
        "return per_member(jnp.zeros_like(factor), (zero, factor))",
        "return per_member(jnp.zeros_like(factor), zero)",
        f"{BATCHED}::test_a_product_with_zero_is_batched_as_both_factors",
    ),
    "first order of kinks alike for all members": Mutant(
        "steps/switch_derivatives.py",
        "return per_member(jax.tree.map(jnp.zeros_like, at[1]), at)",
        "return jax.tree.map(jnp.zeros_like, at[1])",
        f"{ENDS_MOVED}[forward twice]",
    ),
    "kinks alike for all members": Mutant(
        "steps/switch_derivatives.py",
        "return per_member(jax.tree.map(jnp.zeros_like, at[1]), (at, changes))",
        "return jax.tree.map(jnp.zeros_like, at[1])",
        ENDS_MOVED,
    ),
    "inverse inertia alike for all members": Mutant(
        "mechanics/rates.py",
        "return per_member(pair, primals)",
        "return pair",
        ENDS_MOVED,
    ),
    # Judging steps
    "probe off": Mutant(
        "steps/derivative_control.py",
        "ratio = constant(jnp.where(finite, ratio, 0))",
        "ratio = jnp.zeros_like(ratio)",
        "at rest, adjoint",
    ),
    "tangents are not judged": Mutant(
        "steps/derivative_control.py",
        "ratio = constant(jnp.where(jnp.isnan(ratio), 0, ratio))",
        "ratio = jnp.zeros_like(ratio)",
        "at rest, tangents",
    ),
    "one tangent is not judged": Mutant(
        "steps/derivative_control.py",
        "ratio = jnp.where(allowed > 0, error / allowed, 0)",
        "judged = (allowed > 0) & (jax.lax.axis_index(TANGENTS) > 0)\n"
        "    ratio = jnp.where(judged, error / allowed, 0)",
        "at rest, tangents",
    ),
    "noise floor off": Mutant(
        "steps/judge.py",
        "is_noise = error_size < _NOISE * rounding",
        "is_noise = error_size < 0 * rounding",
        "tests/hard/test_motions.py::test_rounding_does_not_shorten_steps",
    ),
    # Methods
    "compensation off": Mutant(
        "steps/dopri8.py",
        "return y, jax.tree.map(lambda a, b, c: c - (b - a), y0, y, change)",
        "return y, jax.tree.map(jnp.zeros_like, y)",
        "tests/test_solvers.py::test_a_sum_of_many_steps_loses_no_digit",
    ),
    "a stale rate after a jump": Mutant(
        "steps/unrolled_dopri8.py",
        "if made_jump is not False:",
        "if False:",
        "switching, batch",
    ),
    # Joints that are held
    "a blow goes on": Mutant(
        "simulation/events.py",
        "flying = jnp.where(one, -e * qd,",
        "flying = jnp.where(one, e * qd,",
        BOUNCES,
    ),
    "a restitution has no derivative": Mutant(
        "simulation/events.py",
        "e = law.restitution[k]",
        "e = constant(law.restitution[k])",
        f"{HOLDING}::test_a_batch_has_the_derivatives_of_closed_forms",
    ),
    "low flights go on": Mutant(
        "simulation/events.py",
        "low = pulled & (constant(qd**2) <= 2 * towards * lowest)",
        "low = jnp.zeros_like(pulled)",
        BOUNCES,
    ),
    "a blow without restitution is a bounce": Mutant(
        "simulation/events.py",
        "_BOUNCES: hit & (law.restitution > 0),",
        "_BOUNCES: hit,",
        f"{ONE_JOINT}[a blow without restitution, and a pull away]",
    ),
    "rounding frees joints": Mutant(
        "simulation/events.py",
        "rests = joints & (jnp.abs(constant(qd)) <= constant(still))",
        "rests = joints & (qd == 0)",
        f"{SEVERAL}::test_a_rounding_error_frees_no_joint",
    ),
    "a payload takes no energy": Mutant(
        "simulation/events.py",
        "            lost += more\n",
        "",
        "tests/test_simulation.py::test_a_payload_is_taken_once_where_phases_meet[0]",
    ),
    "a payload arrives without momentum": Mutant(
        "simulation/events.py",
        "impulse += jnp.where(new, weights * (own - carried) @ jacobian, 0)",
        "impulse += jnp.where(new, weights * own @ jacobian, 0)",
        "holding elements",
    ),
    # Joints that are prescribed
    "a prescribed velocity jumps without a blow": Mutant(
        "steps/loop.py",
        "y0, stale = term.settle(a.t, y0, args), True",
        "pass",
        f"{HYBRID}::test_a_pendulum_on_a_cart[0.6-0]",
    ),
    "a prescribed acceleration moves no other joint": Mutant(
        "simulation/vector_field.py",
        "        tau = minus(tau, times(m.mass, given))",
        "        pass",
        f"{ON_TABLE}[friction lets a load slip]",
    ),
    "a held load resists no blow": Mutant(
        "simulation/events.py",
        "y = with_prescribed_rates(event.t, y, args._replace(modes=braked))",
        "pass",
        f"{ON_TABLE}[a kicked table slips under its load]",
    ),
    "static friction is that of sliding": Mutant(
        "simulation/holding.py",
        "static = jnp.where(law.braked, jnp.inf, law.static)",
        "static = jnp.where(law.braked, jnp.inf, law.level)",
        f"{ONE_JOINT}[static friction holds what has come to rest]",
    ),
    # What acts on held and prescribed joints
    "events are turned the wrong way": Mutant(
        "simulation/events.py",
        "jnp.roll(row, -first)",
        "jnp.roll(row, first)",
        f"{ONE_JOINT}[105 bounces]",
    ),
    "an upper stop does not push": Mutant(
        "simulation/holding.py",
        "least = jnp.where(held_as == UPPER, -jnp.inf, -toward(static, 1))",
        "least = -toward(static, 1)",
        f"{ONE_JOINT}[a blow without restitution, and a rest]",
    ),
    "directions of friction are exchanged": Mutant(
        "forces/holders.py",
        "return jnp.where(jnp.asarray(direction) > 0, *friction)",
        "return jnp.where(jnp.asarray(direction) < 0, *friction)",
        f"{ONE_JOINT}[a push against no friction]",
    ),
    "static friction may be below the level": Mutant(
        "forces/holders.py",
        "level = jnp.where(static < level, jnp.nan, level)",
        "pass",
        f"{HOLDING}::test_friction_that_becomes_what_it_cannot_be_ends_a_motion[0.5]",
    ),
    "prescribed efforts carry no weight": Mutant(
        "simulation/prescribed.py",
        "return jnp.where(moved, matrix @ qdd + bias - tau, 0)",
        "return jnp.where(moved, matrix @ qdd - tau, 0)",
        f"{MASSES}::test_a_motor_lifts_the_mass_of_the_time",
    ),
    "bearings carry no weight of a payload": Mutant(
        "forces/payload.py",
        "force = -self.mass * (plane_vector(x, y) + 1j * linkage.gravity)",
        "force = -self.mass * plane_vector(x, y)",
        f"{MASSES}::test_bearings_carry_the_mass_of_the_time",
    ),
    # Controllers on a clock
    "modes after efforts of before": Mutant(
        "steps/loop.py",
        "    args = args._replace(sampled=a.sampled)\n",
        "",
        f"{SAMPLED}::test_joints_are_held_between_samples",
    ),
    "samples before arrivals": Mutant(
        "simulation/sampled_control.py",
        "acting = *forces, *arrivals, sampler",
        "acting = *arrivals, *forces, sampler",
        f"{SAMPLED}::test_delayed_feedback_follows_its_transition_matrix",
    ),
    "a gap stops the motion": Mutant(
        "steps/loop.py",
        "jnp.where(gap > 0, gap * rate, 0)",
        "0 * rate",
        f"{SAMPLED}::test_no_time_is_left_out_at_samples",
    ),
    "samples before blows": Mutant(
        "simulation/formulation.py",
        "lead[place] = rank - len(clocks)",
        "lead[place] = rank + len(others)",
        f"{SAMPLED}::test_a_sample_sees_what_a_blow_leaves",
    ),
    "a delay of whole periods is less": Mutant(
        "simulation/sampled_control.py",
        "rounding = 4 * float(",
        "rounding = 0 * float(",
        f"{SAMPLED}"
        "::test_a_delay_of_whole_periods_is_known_in_either_precision[float64]",
    ),
    "no command under way is late": Mutant(
        "simulation/sampler.py",
        "acting = under_way[(k - self.late) % len(under_way)]",
        "acting = tau",
        f"{SAMPLED}::test_efforts_are_held_and_come_late",
    ),
    "noise is left out": Mutant(
        "simulation/sampler.py",
        "q, qd = (value + rows[k] for value, rows in zip((q, qd), self.noise))",
        "pass",
        f"{SAMPLED}::test_noise_is_what_the_key_says",
    ),
    # Arithmetic, arms, the paper's equations, tables
    "bearings turn the wrong way": Mutant(
        "base/trigonometry.py",
        "along * y_dot - across * x_dot",
        "along * y_dot + across * x_dot",
        "tests/test_trigonometry.py::test_derivatives_of_angles",
    ),
    "slides half a turn apart are not parallel": Mutant(
        "linkage/singularity.py",
        "abs(np.sin(locked[body].sum()))",
        "abs(locked[body].sum())",
        "tests/test_singularity.py::test_what_is_said_of_an_arm",
    ),
    "pivots alone tell the loss of digits": Mutant(
        "mechanics/solve.py",
        "own = functools.reduce(add, terms, inverse[k])",
        "own = inverse[k]",
        "tests/test_chain_rounding.py::test_health_states_the_loss_of_digits",
    ),
    "half of Coriolis' torque of the last slide": Mutant(
        "paper.py",
        "- m4 * (2 * B3 * v3 * w3 + g * (A3 * c3 - B3 * s3))",
        "- m4 * (B3 * v3 * w3 + g * (A3 * c3 - B3 * s3))",
        "tests/test_reference.py::test_an_instant[RRP-full]",
    ),
    "efforts of fictitious joints count": Mutant(
        "paper.py",
        "effort = jnp.where(real, force, 0)",
        "effort = force",
        "tests/hard/test_traced.py::test_efforts_of_fictitious_joints[RPR]",
    ),
    "rates have the units of positions": Mutant(
        "data/tables.py",
        "(solution.qd, rate_unit)",
        "(solution.qd, str)",
        "tests/test_tables.py::test_a_motion_has_named_joints_with_units",
    ),
    "what creeps from below has settled": Mutant(
        "tuning/within_limits.py",
        "jnp.abs(share_now - 1) - _BAND",
        "share_now - 1 - _BAND",
        "tests/tuning/test_limits.py::test_limits_out_of_reach_are_exceeded_least",
    ),
    # Drives, controllers and tuning
    "fixed pairs of a model accelerate": Mutant(
        "control/pd.py",
        "where(fixed, jnp.zeros_like(b), a + b) for fixed, a, b in rows",
        "a + b for _, a, b in rows",
        "tests/test_chain_elements.py::test_elements_act_alike",
    ),
    "braking is limited as driving is": Mutant(
        "servo/drives.py",
        "right = clip(1 + qd / self.no_load, 0, 1)",
        "right = left",
        "tests/servo/test_drives.py::test_a_speed_limit_in_four_quadrants",
    ),
    "a lag has no time": Mutant(
        "servo/drives.py",
        "return own, (command - own) / self.time_constant",
        "return command, (command - own) / self.time_constant",
        "tests/servo/test_drives.py::test_a_lag_is_an_exponential",
    ),
    "joints that nothing drives count": Mutant(
        "tuning/losses.py",
        "errors = jnp.where(driven, errors, 0)",
        "pass",
        "tests/tuning/test_limits.py"
        "::test_the_errors_of_a_joint_that_nothing_drives_count_nothing[RR-kd1]",
    ),
    "a search leaves what bounds hold": Mutant(
        "tuning/search.py",
        "((z >= high) & (gradient < 0))",
        "((z >= high) & (gradient > 0))",
        "tests/tuning/test_limits.py"
        "::test_runs_that_fail_that_bounds_hold_and_that_are_flat_end_beside_another",
    ),
    # Instants: elements, references, analyses
    "stops hold back what leaves them": Mutant(
        "forces/joints.py",
        "damped = 1 + damping * rate",
        "damped = 1 - damping * rate",
        "tests/test_joint_elements.py::test_efforts_of_a_state",
    ),
    "a damper alone slackens a cable": Mutant(
        "forces/points.py",
        "on = switch(self.side * tension, True, both, continuous=True)",
        "on = True",
        "tests/test_points.py::test_one_sided_springs",
    ),
    "the weight is held about the ground's pivot": Mutant(
        "control/pd.py",
        "turning = moment - mass * start[k + 1].real",
        "turning = moment",
        "tests/test_control.py::test_models_hold_the_weight_or_have_the_inverse_dynamics",
    ),
    "links run along their own x axis": Mutant(
        "mechanics/inverse_kinematics.py",
        "bend = jnp.where(r2, own2 + plane_angle(root, inner) - own3,",
        "bend = jnp.where(r2, own2 + plane_angle(root, inner),",
        "tests/test_kinematics.py"
        "::test_both_branches_reach_the_pose_and_one_is_the_original[RRR]",
    ),
    "a circle is left where its start unwinds": Mutant(
        "references/task.py",
        "return wrist, bearing - 2 * np.pi * whole_turns(first)",
        "return wrist, bearing",
        "tests/test_references.py"
        "::test_the_reference_never_jumps_and_counts_its_turns[around the base-RRR]",
    ),
    "bearings turn about the ground's pivot": Mutant(
        "analysis/reactions.py",
        "about = about_pivot - cross(joint, carried)",
        "about = about_pivot",
        "tests/test_reactions.py"
        "::test_each_link_is_in_balance_and_free_components_are_efforts",
    ),
    # Conditions
    "what switches at once has no time": Mutant(
        "steps/events.py",
        "lambda: jnp.where(comes, 0, last.late),",
        "lambda: jnp.zeros_like(t),",
        f"{CLOSED_FORMS}[a blow switches an effort at once]",
    ),
    "a start on the zero is a passage": Mutant(
        "steps/events.py",
        "passed_zero = passed.switched & ~on_zero",
        "passed_zero = passed.switched",
        f"{CONDITIONS}::test_where_a_reset_leaves_its_condition",
    ),
    "what follows soon is not seen": Mutant(
        "steps/landing.py",
        "short = before & (end < found.soon) & (found.soon < state.overshot)",
        "short = jnp.zeros((), bool)",
        "held, two joints",
    ),
    "a plain function's switches are not dealt": Mutant(
        "forces/element.py",
        "switches.add(values, self.jumping)",
        "pass",
        f"{SWITCHES}::test_switches_of_a_plain_function_are_located",
    ),
    "a run ends where its last step does": Mutant(
        "steps/events.py",
        "end, there = at_zero(self.term, t, y, args, which, ended & comes)",
        "end, there = t, y",
        f"{CLOSED_FORMS}[a fall ends on the floor]",
    ),
    "a jump over a zero is a passage": Mutant(
        "steps/events.py",
        "end, there = at_zero(self.term, t, y, args, which, ended & comes)",
        "end, there = at_zero(self.term, t, y, args, which, ended)",
        f"{CLOSED_FORMS}[a blow carries the condition over its zero]",
    ),
    "conditions have no direction": Mutant(
        "steps/exact_zeros.py",
        "return passed[places] & ((wanted == 0) | (wanted == after[places]))",
        "return passed[places]",
        FIRST_ENDS,
    ),
    "the first condition listed ends a run": Mutant(
        "steps/events.py",
        "return jnp.where(ends.any(), jnp.argmax(ends), -1)",
        "return jnp.where(ends.any(), 0, -1)",
        FIRST_ENDS,
    ),
    "one Newton step to a zero": Mutant(
        "steps/exact_zeros.py",
        "_NEWTON, _CONVERGED = 3, 0.01",
        "_NEWTON, _CONVERGED = 1, 2.0",
        f"{CLOSED_FORMS}[a fall ends on the floor]",
    ),
    "straight to a zero": Mutant(
        "steps/exact_zeros.py",
        "middle = _along(y, time / 2, term.vf(t, y, args))",
        "middle = y",
        f"{CLOSED_FORMS}[a bar hangs after an elliptic integral]",
    ),
    "a reset takes no energy": Mutant(
        "simulation/events.py",
        "jnp.subtract(*energies)",
        "jnp.zeros_like(t)",
        f"{CLOSED_FORMS}[a ball is reset twenty times]",
    ),
    "a reset may leave hard stops": Mutant(
        "simulation/events.py",
        "qd = jnp.where(within_stops(args.forces, q, arm), qd, jnp.nan)",
        "pass",
        f"{CONDITIONS}::test_functions_that_return_what_cannot_be_are_named"
        "[wrong3-beyond a hard stop]",
    ),
    "what a reset turns round goes on": Mutant(
        "steps/exact_zeros.py",
        "goes_on = jnp.sign(arrives) * jnp.sign(leaves) > 0",
        "goes_on = leaves < 0",
        EVER_FASTER,
    ),
    "resets count as fast as switches": Mutant(
        "steps/landing.py",
        "power = jnp.where(found.resets, _RESET_PACE, _PACE)",
        "power = _PACE",
        f"{CONDITIONS}::test_where_a_reset_leaves_its_condition",
    ),
    # At an instant
    "a switch within a transformation goes unseen": Mutant(
        "forces/switches.py",
        "if self._transformation != transformation():",
        "if False:",
        f"{SWITCHES}::test_a_switch_that_the_integrator_cannot_see_is_refused[jit]",
    ),
    "what holds joints is free at an instant": Mutant(
        "forces/holders.py",
        "if isinstance(element, Holder) and element.holds:",
        "if False:",
        f"{INSTANT}[equilibrium]",
    ),
    "masses of any time are those of one": Mutant(
        "forces/added_inertia.py",
        "element.at(_ANY) is not element:",
        "element.at(_ANY) is None:",
        f"{INSTANT}[mass_matrix]",
    ),
    "a sampled control acts beside its held efforts": Mutant(
        "simulation/efforts.py",
        "return _Held(motion.ts, motion.acting), *forces[1:]",
        "return _Held(motion.ts, motion.acting), *forces",
        f"{SAMPLED}::test_held_efforts_are_known_with_their_work",
    ),
    "a ramp goes on after its last time": Mutant(
        "servo/signals.py",
        "return q, jnp.where(before | behind, 0, rates)",
        "return q, jnp.where(before, 0, rates)",
        "tests/servo/test_signals.py::test_ramps_stand_before_and_after_their_times",
    ),
    "no kept step shortens the next": Mutant(
        "steps/tolerances.py",
        "shortened = keep & (factor < 1) & (inverse_error != 1)",
        "shortened = keep & (factor < 0)",
        "tests/test_step_control.py"
        "::test_a_kept_step_near_the_tolerance_shortens_the_next",
    ),
}


def noticed(check: str, folder: Path, frozen: Path) -> bool:
    """Returns whether a check fails in a folder."""
    if "::" in check:
        command = ["pytest", "-q", "-x", "-n", "0", "-m", "", check]
    else:
        command = ["benchmarks.frozen", "compare", str(frozen), check]
    done = python(folder, *command)
    failed = "BEYOND" if command[0] != "pytest" else " failed"
    if done.returncode and failed not in done.stdout:
        sys.exit(f"{check} broke:\n{done.stdout}\n{done.stderr}")
    return bool(done.returncode)


def python(folder: Path, *command: str) -> subprocess.CompletedProcess:
    """Runs a module of Python in a folder, with the packages there."""
    env = os.environ | {"PYTHONPATH": f"{folder}{os.pathsep}{folder / 'tests'}"}
    command = sys.executable, "-m", *command
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "names", nargs="*", help=f"by default all: {', '.join(MUTANTS)}"
    )
    parser.add_argument("--frozen", type=Path, help="numbers of the unchanged package")
    options = parser.parse_args()
    if unknown := set(options.names) - set(MUTANTS):
        parser.error(f"names: unknown {', '.join(sorted(unknown))}")
    chosen = {name: MUTANTS[name] for name in options.names or MUTANTS}
    checks = dict.fromkeys(mutant.check for mutant in chosen.values())
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, folder / name)
        frozen = options.frozen and options.frozen.resolve()
        groups = [check for check in checks if "::" not in check]
        if frozen is None and groups:
            frozen = folder / "frozen.npz"
            python(folder, "benchmarks.frozen", "write", str(frozen), *groups)
        if failing := [c for c in checks if noticed(c, folder, frozen)]:
            sys.exit(f"fail without a fault: {', '.join(failing)}")
        survived = 0
        for name, mutant in chosen.items():
            file = folder / "fdof_jax" / mutant.file
            text = file.read_text()
            if text.count(mutant.old) != 1:
                sys.exit(f"{name}: expected its text once in {mutant.file}")
            file.write_text(text.replace(mutant.old, mutant.new))
            died = noticed(mutant.check, folder, frozen)
            file.write_text(text)
            survived += not died
            print(f"{name}: {'died' if died else 'SURVIVED'}", flush=True)
    sys.exit(f"{survived} survived" if survived else 0)


if __name__ == "__main__":
    main()
