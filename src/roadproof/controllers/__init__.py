"""Controllers: what is attacked and what drives."""

from roadproof.controllers.cil import CIL as CIL
from roadproof.controllers.cil import CILOutput as CILOutput
from roadproof.controllers.frames import FramePreparation as FramePreparation
from roadproof.controllers.pilotnet import PILOTNET_ON_CARLA as PILOTNET_ON_CARLA
from roadproof.controllers.pilotnet import PilotNet as PilotNet
from roadproof.controllers.pilotnet import pilotnet_controller as pilotnet_controller
from roadproof.controllers.protocol import Controller as Controller
from roadproof.controllers.steering import CruiseControl as CruiseControl
from roadproof.controllers.steering import SteeringController as SteeringController
