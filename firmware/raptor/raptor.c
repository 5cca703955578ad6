#include "raptor/raptor.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "raptor/reports.h"

#define FRAMES_PER_SECOND (1.0e6f / (float)EXECUTIVE_FRAME_US)

enum { SHUTDOWN_PERIOD = 10 }; /* minor frames between two shutdown messages */

/* What the tasks of one tick work on. */
typedef struct tick_context {
    raptor *self;
    uint64_t now_us;
    const raptor_wired_in *wired;
    const can_frame *in;
    uint32_t in_count;
    raptor_wired_out *drive;
    can_outbox *out;
} tick_context;

/* Speeds at the tread, bounded far above what the car can do. A wheel whose sensor fails keeps its last speed: it must
 * not look like one that stands. */
static void take_wheel_speeds(raptor *self, const raptor_wired_in *wired)
{
    self->wheel_speeds_valid = true;
    for (uint32_t i = 0; i < 4U; i++) {
        codec_status status;
        const float radius = self->config.rolling_radius[i / 2U];
        const float speed = codec_clamp(wired->wheel_speed[i] * radius, -200.0f, 200.0f, &status);
        if (status == CODEC_NOT_FINITE) {
            self->wheel_speeds_valid = false;
        } else {
            self->wheel_speed[i] = speed;
        }
    }
    self->speed = 0.5f * (self->wheel_speed[0] + self->wheel_speed[1]);
}

static void receive(void *context)
{
    const tick_context *tick = context;
    raptor *self = tick->self;

    for (uint32_t i = 0; i < tick->in_count; i++) {
        can_frame frame;
        if (dbw_profile_receive(&self->profile, &tick->in[i], &frame) != DBW_PROFILE_FRAME) {
            continue;
        }
        raptor_command_monitor_receive(&self->commands, &self->config, &frame, self->sys.state, tick->now_us);
        raptor_gateway_receive(&self->gateway, &frame, tick->now_us);
    }
    take_wheel_speeds(self, tick->wired);
}

static void supervise(void *context)
{
    const tick_context *tick = context;
    raptor *self = tick->self;
    const raptor_wired_in *wired = tick->wired;

    raptor_command_monitor_step(&self->commands, &self->config, self->sys.state, tick->now_us);
    raptor_gateway_step(&self->gateway, &self->config, tick->now_us);
    const raptor_diagnostic_input input = {
        .gateway = &self->gateway,
        .sys_state = self->sys.state,
        .obc_lost = (self->commands.faults & RAPTOR_COMMAND_ANY_TIMEOUT) != 0,
        .race_control_linked = wired->race_control.linked,
        .brake_request = self->demand.brake,
        .brake_lines = {wired->brake_pressure_front, wired->brake_pressure_rear},
        .engine_speed = wired->engine_speed,
        .engine_running = wired->engine_running,
    };
    raptor_diagnostic_step(&self->diagnostic, &self->config, &input, tick->now_us);
}

/* Brake held, neutral, battery within its limits. */
static bool crank_conditions(const raptor *self, const raptor_wired_in *wired)
{
    const raptor_config *config = &self->config;
    const float lines[2] = {wired->brake_pressure_front, wired->brake_pressure_rear};
    bool held = true;

    for (uint32_t i = 0; i < 2U; i++) {
        held = held && lines[i] >= config->brake_hold * config->brake_axle_share[i] - config->test_brake_tolerance;
    }
    return held && wired->gear == 0U && wired->battery_voltage >= config->battery_minimum &&
           wired->battery_voltage <= config->battery_maximum;
}

static void step_test(raptor *self, const raptor_wired_in *wired, uint64_t now_us)
{
    const raptor_test_input input = {
        .gateway = &self->gateway,
        .steer_request = self->demand.steer,
        .brake_request = self->demand.brake,
        .brake_lines = {wired->brake_pressure_front, wired->brake_pressure_rear},
    };
    raptor_test_step(&self->test, &self->config, &input, now_us);
}

/* The actuation test sweeps the wheels and lets the brake go: only on a car that stands and is known to. */
static bool subsystems_ready(const raptor *self)
{
    return raptor_gateway_ready(&self->gateway) && raptor_command_monitor_alive(&self->commands) &&
           self->wheel_speeds_valid && fabsf(self->speed) < self->config.standstill_speed;
}

static void step_sys_state(raptor *self, const raptor_wired_in *wired, uint64_t now_us)
{
    const uint8_t before = self->sys.state;
    const raptor_sys_input input = {
        .subsystems_ready = subsystems_ready(self),
        .stopping = self->stopping,
        .emergency = self->commands.faults != 0U || (self->diagnostic.bits & RAPTOR_DIAG_TRIGGERS) != 0U,
        .track_flag_valid = wired->race_control.linked,
        .track_flag = wired->race_control.track_flag,
        .ct_state = self->commands.command.ct_state,
        .safety_switch = wired->safety_switch,
        .test_result = self->test.result,
        .crank_conditions = crank_conditions(self, wired),
        .engine_running = wired->engine_running && wired->engine_speed >= self->config.engine_idle_minimum,
        .engine_stopped = !wired->engine_running && wired->engine_speed < self->config.engine_low_speed,
    };
    raptor_sys_step(&self->sys, &self->config, &input, now_us);
    if (self->sys.state == RAPTOR_SYS_ACT_TESTING && before != RAPTOR_SYS_ACT_TESTING) {
        raptor_test_start(&self->test, &self->config, now_us);
    }
}

static void control(void *context)
{
    const tick_context *tick = context;
    raptor *self = tick->self;

    if (self->sys.state == RAPTOR_SYS_ACT_TESTING) {
        step_test(self, tick->wired, tick->now_us);
    }
    step_sys_state(self, tick->wired, tick->now_us);
    const raptor_demand_input input = {
        .commands = &self->commands,
        .sys_state = self->sys.state,
        .test_steer = self->test.steer,
        .test_brake = self->test.brake,
        .steer_position = self->gateway.steer.position,
        .steer_position_known = self->gateway.steer.known,
        .engine_running = tick->wired->engine_running,
        .gear = tick->wired->gear,
        .gear_shift_status = tick->wired->gear_shift_status,
        .speed = self->speed,
    };
    raptor_demand_step(&self->demand, &self->config, &input, tick->now_us);
    tick->drive->throttle_demand = self->demand.throttle;
    tick->drive->gear_demand = self->demand.gear;
    tick->drive->ignition = self->demand.ignition;
    tick->drive->starter = self->demand.starter;
}

static void send_requests(void *context)
{
    const tick_context *tick = context;
    const raptor_demand *demand = &tick->self->demand;

    raptor_gateway_send_requests(&tick->self->gateway, demand->steer, demand->brake, tick->self->speed, tick->out);
}

static void send_shutdown(void *context)
{
    const tick_context *tick = context;

    if (tick->self->sys.state == RAPTOR_SYS_PWR_OFF) {
        raptor_gateway_send_shutdown(tick->out);
    }
}

/* From one minor frame to the next; 0 until both angles have been known for one. */
static void take_steering_rates(raptor *self)
{
    const raptor_gateway_axis *steer = &self->gateway.steer;
    const bool known = steer->known && steer->channels[0].position_rx.seen;
    const float primary = steer->channels[0].position;
    const float commanded = self->demand.steer;

    self->profile.rates = (dbw_steering_rates){0};
    if (known && self->steering.known) {
        self->profile.rates.primary = (primary - self->steering.primary) * FRAMES_PER_SECOND;
        self->profile.rates.commanded = (commanded - self->steering.commanded) * FRAMES_PER_SECOND;
    }
    self->steering = (raptor_steering_angles){.primary = primary, .commanded = commanded, .known = known};
}

static void send_reports(void *context)
{
    const tick_context *tick = context;

    take_steering_rates(tick->self);
    raptor_reports_send(tick->self, tick->wired, tick->self->schedule.frame, tick->now_us, tick->out);
}

static const executive_task schedule[] = {
    {.run = receive, .period = 1, .offset = 0, .budget_us = 1000},
    {.run = supervise, .period = 1, .offset = 0, .budget_us = 500},
    {.run = control, .period = 1, .offset = 0, .budget_us = 500},
    {.run = send_requests, .period = 1, .offset = 0, .budget_us = 300},
    {.run = send_shutdown, .period = SHUTDOWN_PERIOD, .offset = 5, .budget_us = 100},
    {.run = send_reports, .period = 1, .offset = 0, .budget_us = 1500},
};

enum { SCHEDULE_TASKS = sizeof schedule / sizeof schedule[0] };

const executive_task *raptor_schedule(uint32_t *count)
{
    *count = SCHEDULE_TASKS;
    return schedule;
}

void raptor_init(raptor *self, const raptor_config *config)
{
    memset(self, 0, sizeof *self);
    self->config = config != NULL ? *config : raptor_config_default;
    raptor_command_monitor_init(&self->commands);
    raptor_sys_init(&self->sys);
    raptor_demand_init(&self->demand);
}

bool raptor_select_profile(raptor *self, uint8_t profile)
{
    return dbw_profile_select(&self->profile, profile);
}

void raptor_stop(raptor *self)
{
    self->stopping = true;
}

void raptor_tick(raptor *self, uint64_t now_us, const raptor_wired_in *wired, const can_frame *in, uint32_t in_count,
                 raptor_wired_out *drive, can_outbox *out)
{
    tick_context tick = {
        .self = self,
        .now_us = now_us,
        .wired = wired,
        .in = in,
        .in_count = in_count,
        .drive = drive,
        .out = out,
    };
    const uint32_t first = out->count;
    executive_run(&self->schedule, schedule, SCHEDULE_TASKS, &tick, now_us);
    dbw_profile_send(&self->profile, out, first);
}
