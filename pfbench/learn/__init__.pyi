"""Public names of `pfbench.learn` and the modules that define them."""

from pfbench.learn.trainer import Training as Training
from pfbench.learn.training_data import draw_training_data as draw_training_data
from pfbench.learn.training_job import train as train
