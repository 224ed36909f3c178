"""How good forecasts of adhesion were: docs/track-condition-map.md defines all of it."""
