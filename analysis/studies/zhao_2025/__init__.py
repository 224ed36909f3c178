"""Zhao et al. (2025): cooperative maximum-adhesion control of a multi-motor locomotive."""
