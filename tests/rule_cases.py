"""The cubature rules of the tests, by name."""

from pfbench.filter.gaussian.linearisation_rules import (
    AxisDegree3,
    AxisDegree5,
    RadialDegree3,
    RadialDegree5,
    SimplexDegree3,
    SimplexDegree5,
    SphericalRadialPoints,
)

RULES: dict[str, SphericalRadialPoints] = {
    "ckf3": SphericalRadialPoints(AxisDegree3(), RadialDegree3()),
    "hckf5": SphericalRadialPoints(AxisDegree5(), RadialDegree5()),
    "ssr3": SphericalRadialPoints(SimplexDegree3(), RadialDegree3()),
    "ssr5": SphericalRadialPoints(SimplexDegree5(), RadialDegree5()),
    "mssr": SphericalRadialPoints(SimplexDegree3(), RadialDegree5()),
    "ssr53": SphericalRadialPoints(SimplexDegree5(), RadialDegree3()),
    "mckf": SphericalRadialPoints(AxisDegree3(), RadialDegree5()),
}
