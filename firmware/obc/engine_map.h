/* The engine as feed-forward sees it: torque over engine speed and throttle, and its inverse. */
#ifndef RACELOOP_OBC_ENGINE_MAP_H
#define RACELOOP_OBC_ENGINE_MAP_H

/* Torque at the crankshaft, N m, negative when the engine drags. engine_speed: rad/s. throttle: 0..1. Both are limited
 * to the map. */
float engine_map_torque(float engine_speed, float throttle);

/* Throttle 0..1 for a torque at an engine speed (rad/s); 0 or 1 when the torque (N m) is out of reach. */
float engine_map_throttle(float engine_speed, float torque);

#endif
