#include "obc/ct_state.h"

static uint8_t move(bool condition, uint8_t from, uint8_t to)
{
    return condition ? to : from;
}

/* CAUTION and NOM_RACE share everything but the chequered and the green flag. */
static uint8_t next_racing(uint8_t state, const ct_input *input)
{
    if (input->track_flag == TRACK_FLAG_RED) {
        return CT_COORD_STOP;
    }
    const bool chequered = input->vehicle_flag == VEHICLE_FLAG_CHEQUERED;
    if (state == CT_NOM_RACE) {
        return move(chequered, state, CT_CAUTION);
    }
    if (chequered) {
        return move(input->standing_still, state, CT_CNTRL_SHUTDOWN);
    }
    const bool no_flag = input->vehicle_flag == VEHICLE_FLAG_NONE || input->vehicle_flag == VEHICLE_FLAG_NONE_ALT;
    return move(no_flag && input->track_flag == TRACK_FLAG_GREEN, state, CT_NOM_RACE);
}

uint8_t ct_state_next(uint8_t state, const ct_input *input)
{
    const bool red = input->track_flag == TRACK_FLAG_RED;
    const bool orange = input->track_flag == TRACK_FLAG_ORANGE;
    const bool yellow = input->track_flag == TRACK_FLAG_YELLOW;

    if (input->full_brake && state > CT_INITIALIZED && state < CT_CNTRL_SHUTDOWN) {
        return CT_EMRG_SHUTDOWN;
    }
    if (ct_state_drives(state) && input->vehicle_flag == VEHICLE_FLAG_PURPLE) {
        return CT_EMRG_SHUTDOWN;
    }
    switch (state) {
    case CT_UNINITIALISED:
    case CT_DEFAULT:
        return move(input->raptor_alive && red, state, CT_PWR_ON);
    case CT_PWR_ON:
        return move(input->configuration_accepted, state, CT_INITIALIZED);
    case CT_INITIALIZED:
        return move(input->sys_state == SYS_ACT_TEST_PASSED && red, state, CT_ACT_TEST);
    case CT_ACT_TEST:
        return move(input->sys_state == SYS_CRANKREADY && red, state, CT_CRANKREADY);
    case CT_CRANKREADY:
        return move(input->sys_state == SYS_CRANK_CHECKS_PASSED && orange, state, CT_CRANKING);
    case CT_CRANKING:
        return move(input->sys_state == SYS_ENG_IDLE, state, CT_RACEREADY);
    case CT_RACEREADY:
        return move(yellow && input->nominal, state, CT_INIT_DRIVING);
    case CT_INIT_DRIVING:
        return move(input->sys_state == SYS_DRIVING && yellow, state, CT_CAUTION);
    case CT_CAUTION:
    case CT_NOM_RACE:
        return next_racing(state, input);
    case CT_COORD_STOP:
        return move(yellow || input->track_flag == TRACK_FLAG_GREEN, state, CT_CAUTION);
    default:
        return state;
    }
}

bool ct_state_drives(uint8_t state)
{
    return state == CT_CAUTION || state == CT_NOM_RACE || state == CT_COORD_STOP;
}
