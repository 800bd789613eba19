"""Version of the random number generator, which is part of the key of every job.

A change of any number that the generator draws, by however little, raises it: results of two versions
are not of the same random numbers. It stands alone, because keys are computed without torch.
"""

GENERATOR_VERSION = 2
