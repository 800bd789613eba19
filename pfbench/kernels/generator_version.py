"""Version of the random number generator, which is part of the key of every job.

A change of any number that the generator draws, by however little, raises it. Results of two versions
are not of the same random numbers. The module imports nothing, since keys are computed without torch.
"""

GENERATOR_VERSION = 2
