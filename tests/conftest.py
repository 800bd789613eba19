"""One thread for each test process: with xdist, more threads than cores make everything slower."""

import torch

torch.set_num_threads(1)
