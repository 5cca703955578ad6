/* Second backup: pure pursuit (R. C. Coulter, CMU-RI-TR-92-01) from the rear axle, with the slip angles of steady
 * cornering added. Stateless. */
#ifndef RACELOOP_OBC_PURE_PURSUIT_H
#define RACELOOP_OBC_PURE_PURSUIT_H

#include "obc/lateral.h"

/* Road wheel angle wished, rad, not limited. */
float pure_pursuit_command(const lateral_state *state);

#endif
