"""The program that lets a UR robot take corrections: a URScript thread beside the running path.

Not yet run on a controller; its arithmetic is evaluated in the tests. It superimposes a path
offset in base coordinates (``path_offset_set``, PolyScope 5.6 and later).
"""

from __future__ import annotations

from dtwin.errors import InputError
from dtwin.links import ur_registers as registers
from dtwin.links.layout import APPLIED_SEQUENCE

_TICK_HZ = 500
_LARGEST_UM = 2000.0
_LONGEST_S = 10.0

_FUNCTIONS = """\
def dtwin_within(value, limit):
  if value > limit:
    return limit
  elif value < 0.0 - limit:
    return 0.0 - limit
  end
  return value
end

def dtwin_towards(now, wanted, step):
  return now + dtwin_within(wanted - now, step)
end

def dtwin_square(x, y, z):
  return x * x + y * y + z * z
end

# Applied x, y, z in um, latched x, y, z, last sequence, ticks since it changed; more than
# {watchdog} of these: a correction was dropped, and nothing counts before a vector of zeros.
def dtwin_correct(s, sequence, x, y, z):
  local wanted = [s[3], s[4], s[5]]
  local idle = s[7]
  if sequence == s[6]:
    idle = idle + 1
    if idle > {watchdog}:
      idle = {watchdog}
      if dtwin_square(wanted[0], wanted[1], wanted[2]) > 0.0:
        idle = {watchdog} + 1
      elif s[7] > {watchdog}:
        idle = {watchdog} + 1
      end
      wanted = [0.0, 0.0, 0.0]
    end
  elif idle <= {watchdog}:
    wanted = [dtwin_within(x, {limit}), dtwin_within(y, {limit}), dtwin_within(z, {limit})]
    idle = 0
  elif dtwin_square(x, y, z) == 0.0:
    idle = 0
  end
  return [dtwin_towards(s[0], wanted[0], {step}), dtwin_towards(s[1], wanted[1], {step}), \
dtwin_towards(s[2], wanted[2], {step}), wanted[0], wanted[1], wanted[2], sequence, idle]
end

# Number of the vector in force; 0 for none.
def dtwin_in_force(s):
  if s[7] > {watchdog}:
    return 0
  end
  return s[6]
end
"""

_THREAD = """\
thread dtwin_correction():
  path_offset_set_max_offset({limit_m}, 0.001)
  path_offset_set_alpha_filter(1.0)
  path_offset_enable()
  # What stands in the registers from before is no correction: it begins as after the watchdog.
  local s = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, read_input_integer_register({sequence_in}), \
{watchdog} + 1]
  while True:
    s = dtwin_correct(s, read_input_integer_register({sequence_in}), \
read_input_float_register({x_in}), read_input_float_register({y_in}), \
read_input_float_register({z_in}))
    path_offset_set(p[s[0] / 1000000.0, s[1] / 1000000.0, s[2] / 1000000.0, 0, 0, 0], 1)
    write_output_integer_register({sequence_out}, dtwin_in_force(s))
    write_output_float_register({x_out}, s[0])
    write_output_float_register({y_out}, s[1])
    write_output_float_register({z_out}, s[2])
    sync()
  end
end
"""


def _correction_functions(limit_um: float, slew_um_s: float, watchdog_s: float) -> str:
    """Return the arithmetic of one controller tick as URScript functions.

    ``limit_um``: largest offset along each axis.
    ``watchdog_s``: time without a new sequence number after which the offset is led back to zero. From then on no
    vector counts before one of zeros has come: whoever was away begins at zero.
    """
    if not (
        0.0 < limit_um <= _LARGEST_UM
        and 0.0 < slew_um_s < _LARGEST_UM * _TICK_HZ
        and 2.0 / _TICK_HZ <= watchdog_s <= _LONGEST_S
    ):
        raise InputError(
            "these are no limits for a correction",
            code="ur.limits",
            got=f"{limit_um:g} um, {slew_um_s:g} um/s, watchdog {watchdog_s:g} s",
            allowed=f"up to {_LARGEST_UM:g} um, a positive rate, a watchdog of 2 ticks to {_LONGEST_S:g} s",
        )
    return _FUNCTIONS.format(
        limit=float(limit_um), step=float(slew_um_s / _TICK_HZ), watchdog=round(watchdog_s * _TICK_HZ)
    )


def correction_program(limit_um: float = 500.0, slew_um_s: float = 20_000.0, watchdog_s: float = 0.012) -> str:
    """Return what belongs before the motion of a robot's program, started by ``run``.

    ``limit_um``, ``slew_um_s``, ``watchdog_s``: as for :func:`correction_functions`.
    """
    outputs = registers.OUTPUT_DOUBLES
    x_out, y_out, z_out = (r for r, place in sorted(outputs.items()) if r >= 17)
    sequence_out = next(r for r, p in registers.OUTPUT_INTS.items() if p == APPLIED_SEQUENCE)
    functions = _correction_functions(limit_um, slew_um_s, watchdog_s)
    thread = _THREAD.format(
        limit_m=limit_um / 1e6,
        watchdog=round(watchdog_s * _TICK_HZ),
        sequence_in=registers.INPUT_SEQUENCE,
        x_in=registers.INPUT_OFFSET_X,
        y_in=registers.INPUT_OFFSET_X + 1,
        z_in=registers.INPUT_OFFSET_X + 2,
        sequence_out=sequence_out,
        x_out=x_out,
        y_out=y_out,
        z_out=z_out,
    )
    return (
        f"# Corrections of dtwin as a path offset in base coordinates. Not yet run on a controller.\n"
        f"# Limits: {limit_um:g} um along each axis, {slew_um_s:g} um/s; back to zero {watchdog_s:g} s\n"
        f"# after the last new sequence number, and from then on nothing before a vector of zeros.\n"
        f"# Begin it in the program with:\n"
        f"#   dtwin_thread = run dtwin_correction()\n"
        f"# and end it, before path_offset_disable(), with:  kill dtwin_thread\n"
        f"{functions}\n{thread}"
    )
