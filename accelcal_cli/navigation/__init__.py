"""Gravity-aided inertial navigation: map, INS error model, voyage, bound and filters [depf2015]."""
