"""Fitted models as what people run: functions, and parameters of controllers, filters and simulators."""
