"""The public Python interface: navigation aided by BeiDou RDSS and GNSS, without the daemon.

What stands in `__all__` is the public interface, described in `docs/python.md`: load a
configuration, feed a `Navigator` with arrays or let `process` read files, `compare` with a truth,
take models and estimators apart. Everything else may change between two versions.

A name is imported when it is first used: `import fusiond` alone loads neither numpy nor a kernel.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the same names as in _HOMES, for whoever reads types
    from drivers.measurements import Attitude as Attitude
    from drivers.measurements import Bearing as Bearing
    from drivers.measurements import DelayedFix as DelayedFix
    from drivers.measurements import Heading as Heading
    from drivers.measurements import Height as Height
    from drivers.measurements import MonotonicStamp as MonotonicStamp
    from drivers.measurements import PositionFix as PositionFix
    from drivers.measurements import WheelSpeed as WheelSpeed
    from fusiond.configuration.load import ConfigError as ConfigError
    from fusiond.configuration.load import load_config as load_config
    from fusiond.configuration.schema import Config as Config
    from fusiond.configuration.si_units import imu_noise as imu_noise
    from fusiond.estimators.base import Estimator as Estimator
    from fusiond.files.csv_tables import TableError as TableError
    from fusiond.files.measurement_csv import TrajectoryTable as TrajectoryTable
    from fusiond.files.measurement_csv import read_attitude as read_attitude
    from fusiond.files.measurement_csv import read_bearing as read_bearing
    from fusiond.files.measurement_csv import read_gnss as read_gnss
    from fusiond.files.measurement_csv import read_imu as read_imu
    from fusiond.files.measurement_csv import read_rdss as read_rdss
    from fusiond.files.measurement_csv import read_solution as read_solution
    from fusiond.files.measurement_csv import read_truth as read_truth
    from fusiond.files.measurement_csv import read_wheel as read_wheel
    from fusiond.files.solutions_to_table import trajectory_of as trajectory_of
    from fusiond.models.blocks import Block as Block
    from fusiond.models.catalogue import MODELS as MODELS
    from fusiond.models.catalogue import make_model as make_model
    from fusiond.models.model import Model as Model
    from fusiond.navigation.solution import Mode as Mode
    from fusiond.navigation.solution import Solution as Solution
    from fusiond.navigator.assembly import estimator_of as estimator_of
    from fusiond.navigator.assembly import model_of as model_of
    from fusiond.navigator.navigator import Navigator as Navigator
    from fusiond.offline.compare import NothingToCompareError as NothingToCompareError
    from fusiond.offline.compare import compare as compare
    from fusiond.offline.process import process as process
    from fusiond.simulation.files import simulate as simulate
    from fusiond.simulation.scenarios import SCENARIOS as SCENARIOS

_HOMES = {
    "drivers.measurements": (
        *("Attitude", "Bearing", "DelayedFix", "Heading", "Height", "MonotonicStamp"),
        *("PositionFix", "WheelSpeed"),
    ),
    "fusiond.configuration.load": ("ConfigError", "load_config"),
    "fusiond.configuration.schema": ("Config",),
    "fusiond.configuration.si_units": ("imu_noise",),
    "fusiond.estimators.base": ("Estimator",),
    "fusiond.files.csv_tables": ("TableError",),
    "fusiond.files.measurement_csv": (
        *("TrajectoryTable", "read_attitude", "read_bearing", "read_gnss", "read_imu"),
        *("read_rdss", "read_solution", "read_truth", "read_wheel"),
    ),
    "fusiond.files.solutions_to_table": ("trajectory_of",),
    "fusiond.models.blocks": ("Block",),
    "fusiond.models.catalogue": ("MODELS", "make_model"),
    "fusiond.models.model": ("Model",),
    "fusiond.navigation.solution": ("Mode", "Solution"),
    "fusiond.navigator.assembly": ("estimator_of", "model_of"),
    "fusiond.navigator.navigator": ("Navigator",),
    "fusiond.offline.compare": ("NothingToCompareError", "compare"),
    "fusiond.offline.process": ("process",),
    "fusiond.simulation.files": ("simulate",),
    "fusiond.simulation.scenarios": ("SCENARIOS",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

if not TYPE_CHECKING:  # a type checker has the imports above, and takes __getattr__ for any name
    __all__ = list(_HOME_OF)

    def __getattr__(name: str) -> object:
        try:
            home = _HOME_OF[name]
        except KeyError:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
        value = globals()[name] = getattr(import_module(home), name)
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
