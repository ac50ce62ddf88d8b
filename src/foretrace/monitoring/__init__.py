"""Monitoring: executions against what was imagined, and what they tell of the physics."""

from foretrace.monitoring.calibration import MonitorCalibration
from foretrace.monitoring.drift import Drift
from foretrace.monitoring.identification import identify
from foretrace.monitoring.information import information_gain
from foretrace.monitoring.monitor import Monitor
from foretrace.monitoring.verdict import Verdict

__all__ = ["Drift", "Monitor", "MonitorCalibration", "Verdict", "identify", "information_gain"]
