/* Wires between the plant and the two actuator ECUs: arrays of plant variables to and from wired structs.
 *
 * The enums name the plant's variables: PLANT_OUT_BRAKE_PRESSURE_FRONT is the FMU's output brake_pressure_front.
 * bridge/plant.py reads the names from here, so that an FMU is checked against exactly what is wired.
 */
#ifndef RACELOOP_WIRING_H
#define RACELOOP_WIRING_H

#include "raptor/raptor.h"
#include "space_drive/space_drive.h"

/* Place of each plant output in the array of outputs, SI units. Wheels: FL, FR, RL, RR. */
enum plant_output {
    PLANT_OUT_X = 0,
    PLANT_OUT_Y,
    PLANT_OUT_Z,
    PLANT_OUT_YAW,
    PLANT_OUT_VX,
    PLANT_OUT_VY,
    PLANT_OUT_YAW_RATE,
    PLANT_OUT_ROLL,
    PLANT_OUT_PITCH,
    PLANT_OUT_BODY_ROLL,
    PLANT_OUT_BODY_PITCH,
    PLANT_OUT_AX,
    PLANT_OUT_AY,
    PLANT_OUT_SPECIFIC_FORCE_X,
    PLANT_OUT_SPECIFIC_FORCE_Y,
    PLANT_OUT_SPECIFIC_FORCE_Z,
    PLANT_OUT_WHEEL_SPEED_FL,
    PLANT_OUT_WHEEL_SPEED_FR,
    PLANT_OUT_WHEEL_SPEED_RL,
    PLANT_OUT_WHEEL_SPEED_RR,
    PLANT_OUT_WHEEL_LOAD_FL,
    PLANT_OUT_WHEEL_LOAD_FR,
    PLANT_OUT_WHEEL_LOAD_RL,
    PLANT_OUT_WHEEL_LOAD_RR,
    PLANT_OUT_ENGINE_SPEED,
    PLANT_OUT_ENGINE_TORQUE,
    PLANT_OUT_WHEEL_TORQUE,
    PLANT_OUT_THROTTLE_POSITION,
    PLANT_OUT_CLUTCH_ENGAGEMENT,
    PLANT_OUT_BRAKE_PRESSURE_FRONT,
    PLANT_OUT_BRAKE_PRESSURE_REAR,
    PLANT_OUT_STEER_MOTOR_ANGLE,
    PLANT_OUT_STEER_WHEEL_ANGLE,
    PLANT_OUT_FUEL_PRESSURE,
    PLANT_OUT_OIL_PRESSURE,
    PLANT_OUT_TRANSMISSION_PRESSURE,
    PLANT_OUT_COOLANT_TEMPERATURE,
    PLANT_OUT_OIL_TEMPERATURE,
    PLANT_OUT_TRANSMISSION_TEMPERATURE,
    PLANT_OUT_TYRE_TEMPERATURE_FL,
    PLANT_OUT_TYRE_TEMPERATURE_FR,
    PLANT_OUT_TYRE_TEMPERATURE_RL,
    PLANT_OUT_TYRE_TEMPERATURE_RR,
    PLANT_OUT_TYRE_PRESSURE_FL,
    PLANT_OUT_TYRE_PRESSURE_FR,
    PLANT_OUT_TYRE_PRESSURE_RL,
    PLANT_OUT_TYRE_PRESSURE_RR,
    PLANT_OUT_BATTERY_VOLTAGE,
    PLANT_OUT_SLIP_ANGLE,
    PLANT_OUT_DISTANCE,
    PLANT_OUT_GEAR,
    PLANT_OUT_GEAR_SHIFT_STATUS,
    PLANT_OUT_ENGINE_RUNNING,
    PLANT_OUT_COUNT
};

/* Place of each plant input in the array of inputs, SI units. */
enum plant_input {
    PLANT_IN_STEER_MOTOR_DEMAND = 0,
    PLANT_IN_BRAKE_PRESSURE_DEMAND,
    PLANT_IN_THROTTLE_DEMAND,
    PLANT_IN_ROAD_BANK,
    PLANT_IN_ROAD_GRADE,
    PLANT_IN_ROAD_FRICTION,
    PLANT_IN_GEAR_DEMAND,
    PLANT_IN_IGNITION,
    PLANT_IN_STARTER,
    PLANT_IN_COUNT
};

/* N/m, spring of one corner in the AV-21 model of AWSIM. The plant has no suspension: a potentiometer reads the wheel's
 * load over this rate, which is the travel from full droop if wheel and spring move alike (motion ratio 1, ours). */
enum { WIRING_SPRING_RATE = 200000 };

/* Sense the plant. outputs: PLANT_OUT_COUNT values; a value that its wire cannot hold becomes 0.
 * raptor_in: switches and race control stay as they are. */
void wiring_sense(const double *outputs, raptor_wired_in *raptor_in, space_drive_wired_in *space_drive_in);

/* Drive the plant. inputs: PLANT_IN_COUNT values, of which those of the road stay as they are. */
void wiring_drive(const raptor_wired_out *raptor_out, const space_drive_wired_out *space_drive_out, double *inputs);

#endif
