component dtwin_correction "Takes corrections from a program outside, and drops them when it falls silent";
description """
The program writes the three values first and the sequence number last. A change of the number
latches the whole vector. Without a change for watchdog_s the target is zero, and the correction goes
there at its slew limit, whatever happened to the program. A correction that was dropped so comes back
only from zero: until a vector of zeros has come, none is latched. Connect counts_* to
axis.*.eoffset-counts and set axis.*.eoffset-scale to 1e-5 (a count is 0.01 um).
""";
pin in float x "um, wanted.";
pin in float y;
pin in float z;
pin in unsigned sequence "Changes with every vector; 0: none yet.";
pin out signed counts_x "0.01 um.";
pin out signed counts_y;
pin out signed counts_z;
pin out unsigned latched "Sequence number of the vector in force; 0 after the watchdog.";
pin out unsigned trips "How often the watchdog dropped a correction.";
pin out unsigned cycles "Of the servo thread.";
param rw float limit = 50.0 "um, longest vector.";
param rw float slew = 4000.0 "um/s, of the vector.";
param rw float watchdog_s = 0.05;
variable double target[3];
variable double applied[3];
variable double silent_s;
variable unsigned last;
variable int dropped;
function _ fp;
license "Apache-2.0";
author "dtwin";
;;
#include <rtapi_math.h>

static void shorten(double *v, double longest) {
    const double length = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    int i;
    if (length > longest) for (i = 0; i < 3; i++) v[i] *= longest / length;
}

FUNCTION(_) {
    const double step_s = period * 1e-9;
    double change[3];
    int i;
    cycles++;
    silent_s += step_s;
    if (sequence != last) {
        last = sequence;
        if (!dropped || (x == 0.0 && y == 0.0 && z == 0.0)) {
            dropped = 0;
            silent_s = 0.0;
            latched = sequence;
            target[0] = x; target[1] = y; target[2] = z;
            for (i = 0; i < 3; i++)
                /* Not a number compares false: the whole vector is refused. */
                if (!(fabs(target[i]) < 1e6)) target[0] = target[1] = target[2] = 0.0;
            shorten(target, limit);
        }
    } else if (latched && silent_s > watchdog_s) {
        latched = 0;
        /* A client that goes away at zero has done it right. */
        if (target[0] != 0.0 || target[1] != 0.0 || target[2] != 0.0) {
            trips++;
            dropped = 1;
        }
        for (i = 0; i < 3; i++) target[i] = 0.0;
    }
    for (i = 0; i < 3; i++) change[i] = target[i] - applied[i];
    shorten(change, slew * step_s);
    for (i = 0; i < 3; i++) applied[i] += change[i];
    counts_x = lrint(applied[0] * 100.0);
    counts_y = lrint(applied[1] * 100.0);
    counts_z = lrint(applied[2] * 100.0);
}
