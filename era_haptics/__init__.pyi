# The names of the package and where each is defined: for type checkers, and for `__init__.py`.
from controller.api.client import AsyncClient as AsyncClient
from controller.api.client import Client as Client
from controller.api.jsonrpc import NotSilent as NotSilent
from controller.api.jsonrpc import RpcError as RpcError
from controller.api.link import LeaseLost as LeaseLost
from controller.api.link import Notification as Notification
from controller.api.link import Unreachable as Unreachable
from controller.demo.simulated_plate import FingerVibration as FingerVibration
from drivers.by_hand.actions import BlockingAmplifier as BlockingAmplifier
from drivers.errors import CommandError as CommandError
from drivers.errors import CommandRefused as CommandRefused
from drivers.errors import DriverError as DriverError
from drivers.errors import LinkError as LinkError
from era_haptics.drive import Drive as Drive
from era_haptics.lab.design.assessment import Assessment as Assessment
from era_haptics.lab.design.design_run import design as design
from era_haptics.lab.design.results import Design as Design
from era_haptics.lab.design.results import RankedLayout as RankedLayout
from era_haptics.lab.rig_page.html_page import page as page
from era_haptics.panel import SimulatedPanel as SimulatedPanel
from era_haptics.panel import simulated_panel as simulated_panel
from era_haptics.plates import SolvedPlate as SolvedPlate
from era_haptics.plates import draw_answer as draw_answer
from era_haptics.plates import draw_contents as draw_contents
from era_haptics.plates import draw_contrast_map as draw_contrast_map
from era_haptics.plates import draw_map as draw_map
from era_haptics.plates import draw_playback as draw_playback
from era_haptics.rigs import EraKeys, ExciterKeys, PlateKeys
from era_haptics.rigs import calibrate as calibrate
from era_haptics.rigs import commands_for as commands_for
from era_haptics.rigs import open_amplifier as open_amplifier
from era_haptics.tables import answer as answer
from era_haptics.tables import contrast_map as contrast_map
from era_haptics.tables import measures as measures
from era_haptics.tables import query as query
from era_haptics.tables import table as table
from model.answer.answer import Answer as Answer
from model.answer.answer import Layer as Layer
from model.answer.answer import Sensation as Sensation
from model.answer.answer_report import Measures as Measures
from model.answer.envelope import Course as Course
from model.answer.stimulus import Finger as Finger
from model.answer.stimulus import Stimulus as Stimulus
from model.config.document import ConfigError as ConfigError
from model.errors import InputError as InputError
from model.estimate.calibration_result import Calibration as Calibration
from model.finger import Grid as Grid
from model.finger import detection_threshold as detection_threshold
from model.reduction.supported_plate import SupportedModes as SupportedModes
from model.rig.rig import Rig as Rig
from model.rig.rig import Uncertainty as Uncertainty
from model.rig.rig_file import example_rig_path as example_rig_path
from model.rig.rig_file import load_rig as load_rig
from model.rig.rig_writing import change_rig as change_rig
from model.rig.rig_writing import rig as rig
from model.rig.rig_writing import save_rig as save_rig
from model.structure.fingertips import Fingertip as Fingertip
from model.study.contrast_maps import ContrastMap as ContrastMap
from model.table.table import LocalizationTable as LocalizationTable
from model.table.table_file import load_table as load_table
from model.table.table_file import save_table as save_table
from model.vibration import FrequencySweep as FrequencySweep
from model.vibration import PlateMap as PlateMap
from model.vibration import Tone as Tone
from registry.limits import GuardLimits as GuardLimits
from sim.plant.fingers import FingerRecord
from sim.plant.plate_playback import FeltFinger as FeltFinger
from sim.plant.plate_playback import PlatePlayback
from sim.plant.plate_playback import Vibration as Vibration

Era = EraKeys
Exciter = ExciterKeys
Plate = PlateKeys
Playback = PlatePlayback
Record = FingerRecord

_HOMES: dict[str, tuple[str, str]]
__all__: list[str]
