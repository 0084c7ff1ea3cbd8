component dtwin_plant "Axes of a mill with faults, and a ball bar between table and spindle";
description """
Follows the motor commands of three joints as a mill with faults would: a position loop with velocity
feed-forward, play behind the encoder, a screw with a wrong and a wavy pitch, an Y axis that is not
square to X. A ball bar measures the distance of the tool from a centre ball. mm, s and um.
""";
pin in float command_x;
pin in float command_y;
pin in float command_z;
pin out float encoder_x "Read by the control.";
pin out float encoder_y;
pin out float encoder_z;
pin out float tool_x "Where the tool is.";
pin out float tool_y;
pin out float tool_z;
pin in float centre_x "Programmed centre of the circle.";
pin in float centre_y;
pin in float centre_z;
pin in float nominal "Length of the bar; 0 without a circle.";
pin out float deviation "Of the bar's length, um.";
param rw float position_gain = 300.0 "Of the position loops, 1/s.";
param rw float feed_forward_x = 0.995 "Share of the commanded speed that is fed forward.";
param rw float feed_forward_y = 0.995;
param rw float feed_forward_z = 0.995;
param rw float play_x = 0.0 "mm, between encoder and carriage.";
param rw float play_y = 0.0;
param rw float play_z = 0.0;
param rw float scale_x = 0.0 "Relative error of the screw.";
param rw float scale_y = 0.0;
param rw float scale_z = 0.0;
param rw float wave_x = 0.0 "mm, amplitude once per turn of the screw.";
param rw float screw_lead = 5.0 "mm per turn.";
param rw float lean_xy = 0.0 "rad, of Y towards X.";
param rw float mounting_x = 0.0 "mm, centre ball from the programmed centre.";
param rw float mounting_y = 0.0;
param rw float mounting_z = 0.0;
param rw float noise = 0.2 "um, of the bar, remembered for 20 ms.";
param rw unsigned noise_state = 1 "State of the generator; not 0.";
variable double before[3];
variable double servo[3];
variable double carriage[3];
variable double shake;
variable int started;
function _ fp;
license "Apache-2.0";
author "dtwin";
;;
#include <rtapi_math.h>

static double uniform(hal_u32_t *state) {
    hal_u32_t s = *state ? *state : 1;
    s ^= s << 13; s ^= s >> 17; s ^= s << 5;
    *state = s;
    return s / 4294967296.0;
}

FUNCTION(_) {
    const double command[3] = {command_x, command_y, command_z};
    const double forward[3] = {feed_forward_x, feed_forward_y, feed_forward_z};
    const double play[3] = {play_x, play_y, play_z};
    const double scale[3] = {scale_x, scale_y, scale_z};
    const double step_s = period * 1e-9;
    double place[3];
    int i;
    for (i = 0; i < 3; i++) {
        if (!started) before[i] = servo[i] = carriage[i] = command[i];
        /* The loop sees the command of the cycle before, as a digital drive does. */
        servo[i] += step_s * position_gain * (before[i] - servo[i])
                  + forward[i] * (command[i] - before[i]);
        before[i] = command[i];
        if (carriage[i] < servo[i] - 0.5 * play[i]) carriage[i] = servo[i] - 0.5 * play[i];
        if (carriage[i] > servo[i] + 0.5 * play[i]) carriage[i] = servo[i] + 0.5 * play[i];
        place[i] = carriage[i] * (1.0 + scale[i]);
    }
    started = 1;
    place[0] += wave_x * sin(2.0 * M_PI * carriage[0] / screw_lead);
    encoder_x = servo[0]; encoder_y = servo[1]; encoder_z = servo[2];
    tool_x = place[0] + lean_xy * place[1]; tool_y = place[1]; tool_z = place[2];
    /* Twelve uniform numbers: nearly normal, unit variance. */
    {
        double sum = -6.0;
        const double kept = exp(-step_s / 0.02);
        for (i = 0; i < 12; i++) sum += uniform(&noise_state);
        shake = kept * shake + sqrt(1.0 - kept * kept) * sum;
    }
    if (nominal > 0.0) {
        const double dx = tool_x - centre_x - mounting_x, dy = tool_y - centre_y - mounting_y;
        const double dz = tool_z - centre_z - mounting_z;
        deviation = 1e3 * (sqrt(dx * dx + dy * dy + dz * dz) - nominal) + noise * shake;
    } else {
        deviation = 0.0;
    }
}
