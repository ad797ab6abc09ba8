"""Parameters as stock firmware has them, and what a set-up that works has besides."""

# ArduCopter 4.5: defaults of the parameters that the audit reads, as far as the firmware has them.
ARDUPILOT_STOCK: dict[str, int | float] = {
    "AHRS_EKF_TYPE": 3,
    "EK3_ENABLE": 1,
    "EK3_GLITCH_RAD": 25,
    "EK3_POS_I_GATE": 500,
    "EK3_SRC_OPTIONS": 1,
    "VISO_TYPE": 0,
    "VISO_DELAY_MS": 10,
    "VISO_POS_X": 0.0,
    "VISO_POS_Y": 0.0,
    "VISO_POS_Z": 0.0,
    "VISO_ORIENT": 0,
    "VISO_SCALE": 1.0,
    "VISO_QUAL_MIN": 0,
    "VISO_POS_M_NSE": 0.2,
    "GPS_TYPE": 1,
    "GPS_TYPE2": 0,
    **{
        f"EK3_SRC{n}_{what}": value
        for n, posxy, velxy, velz in ((1, 3, 3, 3), (2, 0, 0, 0), (3, 0, 0, 0))
        for what, value in (("POSXY", posxy), ("VELXY", velxy), ("POSZ", 1), ("VELZ", velz), ("YAW", 1))
    },
    **{f"RC{n}_OPTION": 0 for n in range(5, 17)},
    **{f"SERIAL{n}_PROTOCOL": protocol for n, protocol in enumerate((2, 2, 5, 5, -1, -1, -1), start=1)},
    **{f"SERIAL{n}_BAUD": baud for n, baud in enumerate((57, 57, 38, 38, 57, 57, 57), start=1)},
}
ARDUPILOT_READY = {**ARDUPILOT_STOCK, "EK3_SRC_OPTIONS": 0, "VISO_TYPE": 1, "EK3_SRC2_POSXY": 6, "RC8_OPTION": 90}

# PX4 1.14: external vision, the height reference is GNSS.
PX4_STOCK: dict[str, int | float] = {
    "EKF2_EV_CTRL": 0,
    "EKF2_EV_DELAY": 0.0,
    "EKF2_EV_NOISE_MD": 0,
    "EKF2_EVP_NOISE": 0.1,
    "EKF2_EV_QMIN": 0,
    "EKF2_EV_POS_X": 0.0,
    "EKF2_EV_POS_Y": 0.0,
    "EKF2_EV_POS_Z": 0.0,
    "EKF2_HGT_REF": 1,
    "EKF2_DELAY_MAX": 200.0,
    "EKF2_GPS_CTRL": 7,
    "EKF2_NOAID_TOUT": 5_000_000,
    "MAV_0_CONFIG": 101,
    "MAV_0_MODE": 0,
    "MAV_1_CONFIG": 0,
    "MAV_1_MODE": 2,
    "MAV_2_CONFIG": 0,
    "MAV_2_MODE": 0,
    "MAV_PROTO_VER": 0,
    "SER_TEL1_BAUD": 57600,
    "SER_TEL2_BAUD": 921600,
}
# PX4 1.18 has slots of auxiliary global position besides.
PX4_WITH_SLOTS: dict[str, int | float] = {
    **PX4_STOCK,
    **{
        f"EKF2_AGP{n}_{what}": value
        for n in range(4)
        for what, value in (("ID", 0), ("CTRL", 0), ("MODE", 0), ("DELAY", 0.0), ("NOISE", 1.0))
    },
}
