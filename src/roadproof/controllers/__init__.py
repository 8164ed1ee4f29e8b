"""Controllers: what is attacked and what drives."""

from roadproof.controllers.cards import ControllerCard as ControllerCard
from roadproof.controllers.checks import ControllerCheck as ControllerCheck
from roadproof.controllers.checks import ControllerReport as ControllerReport
from roadproof.controllers.checks import check_controller as check_controller
from roadproof.controllers.cil import CIL as CIL
from roadproof.controllers.conditional import ConditionalOutput as ConditionalOutput
from roadproof.controllers.conditional_pilotnet import ConditionalPilotNet as ConditionalPilotNet
from roadproof.controllers.frames import FramePreparation as FramePreparation
from roadproof.controllers.loading import load_controller as load_controller
from roadproof.controllers.loading import save_controller as save_controller
from roadproof.controllers.pilotnet import PILOTNET_ON_CARLA as PILOTNET_ON_CARLA
from roadproof.controllers.pilotnet import PilotNet as PilotNet
from roadproof.controllers.pilotnet import pilotnet_controller as pilotnet_controller
from roadproof.controllers.protocol import Controller as Controller
from roadproof.controllers.protocol import PedalController as PedalController
from roadproof.controllers.published import convert_cil as convert_cil
from roadproof.controllers.shipped import ModelCard as ModelCard
from roadproof.controllers.shipped import model_card as model_card
from roadproof.controllers.shipped import shipped_names as shipped_names
from roadproof.controllers.steering import CruiseControl as CruiseControl
from roadproof.controllers.steering import SteeringController as SteeringController
