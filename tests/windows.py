"""Trials whose sensors are known to measure in no time."""

from __future__ import annotations

from dataclasses import replace

import msgspec

KEYS = ("averaging_std_s", "velocity_averaging_std_s")


def with_no_window(trial):
    """Return a trial that states so: no window is looked for, and none is considered."""

    def stated(record):
        own = [key for key in KEYS if hasattr(record.settings, key)]
        known = dict.fromkeys(own, 0.0)
        return replace(record, settings=msgspec.structs.replace(record.settings, **known))

    records = {name: getattr(trial, name) for name in ("gnss", "dvl")}
    records = {name: stated(each) for name, each in records.items() if each is not None}
    return replace(trial, **records, others=tuple(stated(each) for each in trial.others))
