# The public names of mgs: `mgs/__init__.py` reads them from here, and so do type checkers.

from .camera import Camera as Camera
from .camera import look_at as look_at
from .cli.progress import progress_bar as progress_bar
from .data.dataset import Dataset as Dataset
from .data.dataset import load_cameras as load_cameras
from .data.dataset import load_dataset as load_dataset
from .data.frames import Frame as Frame
from .errors import InputError as InputError
from .evaluation import evaluate_model as evaluate_model
from .gaussians import Gaussians as Gaussians
from .prior.build import Prior as Prior
from .prior.build import build_prior as build_prior
from .prior.build import load_prior as load_prior
from .prior.build import prior_from_mesh as prior_from_mesh
from .prior.build import save_prior as save_prior
from .prior.initial import initial_gaussians as initial_gaussians
from .prior.settings import PriorSettings as PriorSettings
from .report.evaluation import evaluate as evaluate
from .report.evaluation import evaluate_run as evaluate_run
from .report.page import write_page as write_page
from .report.writing import write_report as write_report
from .run.folder import Run as Run
from .run.folder import open_run as open_run
from .run.loop import choose as choose
from .run.loop import fit_views as fit_views
from .run.loop import information as information
from .run.loop import learn as learn
from .run.loop import select_views as select_views
from .run.nbv import problem_of as problem_of
from .run.nbv import resume_nbv as resume_nbv
from .run.nbv import run_nbv as run_nbv
from .run.nbv import start_run as start_run
from .run.problem import Problem as Problem
from .run.state import Fitted as Fitted
from .run.state import State as State
from .splat import ListCache as ListCache
from .splat import as_drjit as as_drjit
from .splat import fisher as fisher
from .splat import jvp as jvp
from .splat import render as render
from .splat_ply import read_ply as read_ply
from .splat_ply import write_ply as write_ply
from .synth.rendering import RenderPreset as RenderPreset
from .synth.rendering import synthesise as synthesise

__version__: str
