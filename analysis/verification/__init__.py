"""How good forecasts of adhesion were: docs/adhesion-forecast-verification.md defines all of it."""
