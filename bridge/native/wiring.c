#include "wiring.h"

#include <stddef.h>

/* The plant models the main battery; the Space Drive's second one is a charged lead battery that nothing drains. */
static const float BACKUP_BATTERY = 12.8f; /* V */

static uint8_t small_integer(double value)
{
    return value >= 0.0 && value <= 255.0 ? (uint8_t)value : 0U; /* NaN fails both */
}

void wiring_sense(const double *outputs, raptor_wired_in *raptor_in, space_drive_wired_in *space_drive_in)
{
    for (size_t wheel = 0; wheel < 4; wheel++) {
        raptor_in->wheel_speed[wheel] = (float)outputs[PLANT_OUT_WHEEL_SPEED_FL + wheel];
        raptor_in->wheel_load[wheel] = (float)outputs[PLANT_OUT_WHEEL_LOAD_FL + wheel];
        raptor_in->suspension_travel[wheel] = (float)(outputs[PLANT_OUT_WHEEL_LOAD_FL + wheel] / WIRING_SPRING_RATE);
        raptor_in->tyre_temperature[wheel] = (float)outputs[PLANT_OUT_TYRE_TEMPERATURE_FL + wheel];
        raptor_in->tyre_pressure[wheel] = (float)outputs[PLANT_OUT_TYRE_PRESSURE_FL + wheel];
    }
    raptor_in->engine_speed = (float)outputs[PLANT_OUT_ENGINE_SPEED];
    raptor_in->throttle_position = (float)outputs[PLANT_OUT_THROTTLE_POSITION];
    raptor_in->wheel_torque = (float)outputs[PLANT_OUT_WHEEL_TORQUE];
    raptor_in->brake_pressure_front = (float)outputs[PLANT_OUT_BRAKE_PRESSURE_FRONT];
    raptor_in->brake_pressure_rear = (float)outputs[PLANT_OUT_BRAKE_PRESSURE_REAR];
    raptor_in->fuel_pressure = (float)outputs[PLANT_OUT_FUEL_PRESSURE];
    raptor_in->oil_pressure = (float)outputs[PLANT_OUT_OIL_PRESSURE];
    raptor_in->transmission_pressure = (float)outputs[PLANT_OUT_TRANSMISSION_PRESSURE];
    raptor_in->coolant_temperature = (float)outputs[PLANT_OUT_COOLANT_TEMPERATURE];
    raptor_in->oil_temperature = (float)outputs[PLANT_OUT_OIL_TEMPERATURE];
    raptor_in->transmission_temperature = (float)outputs[PLANT_OUT_TRANSMISSION_TEMPERATURE];
    raptor_in->battery_voltage = (float)outputs[PLANT_OUT_BATTERY_VOLTAGE];
    raptor_in->gear = small_integer(outputs[PLANT_OUT_GEAR]);
    raptor_in->gear_shift_status = small_integer(outputs[PLANT_OUT_GEAR_SHIFT_STATUS]);
    raptor_in->engine_running = outputs[PLANT_OUT_ENGINE_RUNNING] > 0.5;

    /* The brake sensors sit in the line of the stronger axle: the demand is what the stronger axle gets. */
    const double front = outputs[PLANT_OUT_BRAKE_PRESSURE_FRONT];
    const double rear = outputs[PLANT_OUT_BRAKE_PRESSURE_REAR];
    for (size_t channel = 0; channel < SPACE_DRIVE_CHANNELS; channel++) {
        space_drive_in->steer_motor_angle[channel] = (float)outputs[PLANT_OUT_STEER_MOTOR_ANGLE];
        space_drive_in->brake_pressure[channel] = (float)(front > rear ? front : rear);
    }
    space_drive_in->main_battery = (float)outputs[PLANT_OUT_BATTERY_VOLTAGE];
    space_drive_in->backup_battery = BACKUP_BATTERY;
}

void wiring_drive(const raptor_wired_out *raptor_out, const space_drive_wired_out *space_drive_out, double *inputs)
{
    inputs[PLANT_IN_STEER_MOTOR_DEMAND] = (double)space_drive_out->steer_motor_demand;
    inputs[PLANT_IN_BRAKE_PRESSURE_DEMAND] = (double)space_drive_out->brake_pressure_demand;
    inputs[PLANT_IN_THROTTLE_DEMAND] = (double)raptor_out->throttle_demand;
    inputs[PLANT_IN_GEAR_DEMAND] = (double)raptor_out->gear_demand;
    inputs[PLANT_IN_IGNITION] = raptor_out->ignition ? 1.0 : 0.0;
    inputs[PLANT_IN_STARTER] = raptor_out->starter ? 1.0 : 0.0;
}
