"""Frames that another encoder made from the public layouts. They are facts: no code of this project made them."""

from __future__ import annotations

from typing import NamedTuple


class GoldenFrame(NamedTuple):
    """One frame.

    `data` in hex holds as many bytes as the message has; signals that are not named are 0.
    """

    message: str
    data: str
    values: dict[str, float]


GOLDEN = (
    GoldenFrame(
        "steering_cmd", "2d07050000000000", {"steering_motor_ang_cmd": -105.5, "steering_motor_cmd_counter": 5}
    ),
    GoldenFrame("steering_cmd", "a401070000000000", {"steering_motor_ang_cmd": 210.0, "steering_motor_cmd_counter": 7}),
    GoldenFrame("accelerator_cmd", "8d0e030000000000", {"acc_pedal_cmd": 37.25, "acc_pedal_cmd_counter": 3}),
    GoldenFrame("brake_pressure_cmd", "be0a060000000000", {"brake_pressure_cmd": 2750, "brk_pressure_cmd_counter": 6}),
    GoldenFrame("gear_shift_cmd", "0400000000000000", {"desired_gear": 4}),
    GoldenFrame(
        "ct_report",
        "0001000900070500",
        {"track_cond_ack": 1, "ct_state": 9, "ct_state_rolling_counter": 7, "veh_num": 5},
    ),
    GoldenFrame("ct_report_2", "0119000000000000", {"marelli_track_flag_ack": 1, "marelli_vehicle_flag_ack": 25}),
    GoldenFrame(
        "dash_switches_cmd", "3300000000000000", {"driver_traction_aim_switch": 3, "driver_traction_range_switch": 3}
    ),
    GoldenFrame(
        "ct_vehicle_acc_feedback",
        "83fffa0005000000",
        {"long_ct_vehicle_acc_fbk": -1.25, "lat_ct_vehicle_acc_fbk": 2.5, "vertical_ct_vehicle_acc_fbk": 0.05},
    ),
    GoldenFrame(
        "misc_report",
        "8409410604",
        {
            "battery_voltage": 13.2,
            "sys_state": 9,
            "mode_switch_state": 1,
            "raptor_rolling_counter": 200,
            "safety_switch_state": 4,
        },
    ),
    GoldenFrame(
        "wheel_speed_report",
        "09070c0712071407",
        {"wheel_speed_FL": 180.1, "wheel_speed_FR": 180.4, "wheel_speed_RL": 181.0, "wheel_speed_RR": 181.2},
    ),
    GoldenFrame(
        "steering_report", "2d0711", {"steering_motor_ang_avg_fdbk": -105.5, "steering_motor_fdbk_counter": 17}
    ),
    GoldenFrame(
        "brake_pressure_report",
        "be0afc08fa",
        {"brake_pressure_fdbk_front": 2750, "brake_pressure_fdbk_rear": 2300, "brk_pressure_fdbk_counter": 250},
    ),
    GoldenFrame("accelerator_report", "740109", {"acc_pedal_fdbk": 37.2, "acc_pedal_fdbk_counter": 9}),
    GoldenFrame(
        "pt_report_1",
        "c05d0105f781c348",
        {
            "throttle_position": 37.2,
            "current_gear": 4,
            "engine_speed_rpm": 6110,
            "vehicle_speed_kmph": 180.5,
            "engine_run_switch": 1,
            "engine_state": 1,
            "gear_shift_status": 1,
        },
    ),
    GoldenFrame(
        "pt_report_2",
        "0db11069585c0136",
        {
            "fuel_pressure_kPa": 350.5,
            "engine_oil_pressure_kPa": 420.1,
            "coolant_temperature": 88,
            "transmission_temperature": 92,
            "transmission_pressure_kPa": 310,
        },
    ),
    GoldenFrame(
        "diagnostic_report", "0200480000000000", {"sd_system_failure": 1, "est4_sd_comms_loss": 1, "adlink_hb_lost": 1}
    ),
    GoldenFrame(
        "base_to_car_summary",
        "45216407d2040000",
        {
            "base_to_car_heartbeat": 5,
            "track_flag": 4,
            "veh_flag": 1,
            "veh_rank": 2,
            "lap_count": 7,
            "lap_distance": 1234,
            "round_target_speed": 100,
        },
    ),
    GoldenFrame(
        "marelli_report_1",
        "0100007301000000",
        {"marelli_track_flag": 1, "marelli_rc_base_sync_check": 1, "marelli_rc_lte_rssi": -71},
    ),
    GoldenFrame(
        "Tire_Temp_FL_1",
        "073d076d078004b0",
        {"FL_Tire_Temp_01": 85.3, "FL_Tire_Temp_02": 90.1, "FL_Tire_Temp_03": 92.0, "FL_Tire_Temp_04": 20.0},
    ),
    GoldenFrame(
        "req_steer_pos",
        "0040320001030000",
        {"cntrl_pos": 0x4000, "veh_speed": 50, "actv_joystk_steer": 1, "Appl_Message_counter": 3},
    ),
)
