"""Training of learned proposals: public names, imported on first use."""

from pfbench.core.lazy_import import lazy_attributes

__all__ = [
    "Training",
    "draw_training_data",
    "train",
]

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "training_config": ("Training",),
        "training_data": ("draw_training_data",),
        "training_job": ("train",),
    },
)
