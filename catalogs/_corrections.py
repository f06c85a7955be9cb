"""Facts about single stars that the three files do not hold, or hold wrongly. Every row says why it is here."""

from __future__ import annotations

# Hipparcos magnitudes that hold the light of a brighter neighbour within its 30 arcsec aperture (the 1997 catalogue
# marks such entries "-" in H48; Hipparcos-2 dropped the mark). Two magnitudes are from BSC5; the others are Gaia DR3's
# G moved to V by G - V of single Hipparcos stars of the same V-I (-0.02 at 0, -0.09 at 0.5, -0.28 at 1.0).
# Found as entries with Hp - G < -0.5 and a Hipparcos neighbour within 32 arcsec, equal close pairs left out.
NEIGHBOUR_IN_HP_V_MAG = {
    2715: 9.3,
    3843: 10.1,
    24020: 9.1,  # Hp 6.04 beside HIP 24019
    25763: 9.4,
    26220: 6.43,  # theta1 Ori A + B: BSC5 (Hp 4.86 holds theta1 Ori C)
    26224: 6.70,  # theta1 Ori D: BSC5 (Hp 4.77)
    26551: 6.8,  # sigma Ori D (Hp 3.71 is sigma Ori A)
    26878: 9.6,
    31781: 9.7,
    33543: 9.8,
    35034: 9.8,
    39827: 8.9,  # Hp 6.87
    44542: 8.8,  # Hp 6.97
    51662: 7.9,
    69401: 9.8,
    69579: 9.6,
    71502: 8.6,  # Hp 5.86 beside HIP 71500
    72589: 9.6,
    76563: 8.1,
    76566: 8.1,
    88330: 8.9,
    91635: 8.8,
    103571: 7.3,  # Hp 5.34 beside HIP 103569, epsilon Equ
    104833: 9.4,
    106884: 8.0,
    106890: 8.1,  # Hp 5.72 beside HIP 106886
    116016: 9.9,
}

# Stars known to wander over decades by more than they did in Hipparcos's three years: least v_sigma_mag by HR number.
# About a quarter of the range given in the General Catalogue of Variable Stars, more where they moved since 1991.
LONG_TERM_SIGMA_MAG = {
    264: 0.15,  # gamma Cas, 1.6 to 3.0
    1180: 0.15,  # Pleione, 4.8 to 5.5
    1209: 0.25,  # X Per, 6.0 to 7.0
    1605: 0.2,  # epsilon Aur, 2.9 to 3.8, eclipsed every 27 years
    1910: 0.08,  # zeta Tau
    2061: 0.3,  # Betelgeuse, 0.0 to 1.6
    2538: 0.15,  # kappa CMa, 3.4 to 4.0
    2748: 1.5,  # L2 Pup, 2.6 to 8: behind its own dust since 1994
    4621: 0.15,  # delta Cen
    5193: 0.15,  # mu Cen
    5880: 1.5,  # R CrB, 5.7 to 15
    5953: 0.3,  # delta Sco, 1.6 to 2.4: shell star since 2000
    6712: 0.15,  # 66 Oph
    7763: 0.1,  # P Cyg
    8316: 0.3,  # mu Cep, 3.4 to 5.1
    8539: 0.15,  # pi Aqr
    8762: 0.08,  # omicron And
    9045: 0.25,  # rho Cas, 4.1 to 6.2
}

# Of the five entries that Hipparcos observed without a solution for the place, three are in BSC5 as one row or two.
HOLES_HR = {31067: (2366,), 55203: (4374, 4375), 78727: (5977, 5978)}

# The fourth, HIP 115125, is 94 Aqr B, 13 arcsec from 94 Aqr A = HIP 115126. BSC5 has the primary only (HR 8866), which
# Hipparcos-2 has too; and the V 5.19 of the 1997 catalogue is the primary's light in the aperture. So: place from the
# 1997 catalogue's 23 19 06.37 -13 27 17.0 (J1991.25), motion of the primary, V from Gaia DR3's G = 7.36.
HIP_94_AQR_A, HIP_94_AQR_B = 115126, 115125
PLACE_94_AQR_B_DEG = (349.776542, -13.454722)
V_94_AQR_B_MAG = 7.55

# eta Car was V 6.2 when BSC5 was made and has brightened since (Gaia DR3: G 4.03 in 2016).
ETA_CAR_HR = 4210
V_ETA_CAR_MAG, V_SIGMA_ETA_CAR_MAG = 4.2, 0.3
