/* First backup: Stanley's law (G. Hoffmann et al., Autonomous automobile trajectory tracking for off-road driving,
 * ACC 2007) at the front axle, with its steady-state yaw and yaw damping terms. Stateless. */
#ifndef RACELOOP_OBC_STANLEY_H
#define RACELOOP_OBC_STANLEY_H

#include "obc/lateral.h"

/* Road wheel angle wished, rad, not limited. */
float stanley_command(const lateral_state *state);

#endif
