"""A made-up CIL checkpoint: TensorFlow's variables under the published names, with random values."""

import numpy as np

# As the index of carla-simulator/imitation-learning's model.ckpt-450000 lists them.
KERNELS = {
    "W_c_1": (5, 5, 3, 32), "W_c_2": (3, 3, 32, 32), "W_c_3": (3, 3, 32, 64), "W_c_4": (3, 3, 64, 64),
    "W_c_5": (3, 3, 64, 128), "W_c_6": (3, 3, 128, 128), "W_c_7": (3, 3, 128, 256), "W_c_8": (3, 3, 256, 256),
}  # fmt: skip
DENSE_AND_BIASES = {
    "W_f_1": ((8192, 512), "Network/fc1/Variable"),
    "W_f_2": ((512, 512), "Network/fc2/Variable"),
    "W_f_3": ((1, 128), "Network/Speed/fc3/Variable"),
    "W_f_4": ((128, 128), "Network/Speed/fc4/Variable"),
    "W_f_5": ((640, 512), "Network/fc5/Variable"),
    "W_f_6": ((512, 256), "Network/Branch_0/fc6/Variable"),
    "W_f_7": ((256, 256), "Network/Branch_0/fc7/Variable"),
    "W_f_8": ((256, 3), "Network/Branch_0/Variable"),
    "W_f_9": ((512, 256), "Network/Branch_1/fc9/Variable"),
    "W_f_10": ((256, 256), "Network/Branch_1/fc10/Variable"),
    "W_f_11": ((256, 3), "Network/Branch_1/Variable"),
    "W_f_12": ((512, 256), "Network/Branch_2/fc12/Variable"),
    "W_f_13": ((256, 256), "Network/Branch_2/fc13/Variable"),
    "W_f_14": ((256, 3), "Network/Branch_2/Variable"),
    "W_f_15": ((512, 256), "Network/Branch_3/fc15/Variable"),
    "W_f_16": ((256, 256), "Network/Branch_3/fc16/Variable"),
    "W_f_17": ((256, 3), "Network/Branch_3/Variable"),
    "W_f_18": ((512, 256), "Network/Branch_4/fc18/Variable"),
    "W_f_19": ((256, 256), "Network/Branch_4/fc19/Variable"),
    "W_f_20": ((256, 1), "Network/Branch_4/Variable"),
}


def made_up_checkpoint(seed: int) -> dict[str, np.ndarray]:
    """Random values, sized so that a signal passes every layer, and some of the optimiser's variables besides."""
    rng = np.random.default_rng(seed)
    held: dict[str, np.ndarray] = {}
    for layer, (name, shape) in enumerate(KERNELS.items()):
        channels = shape[-1]
        held[name] = rng.normal(0, np.sqrt(2 / np.prod(shape[:3])), shape)
        held[f"Network/conv_block{layer}/Variable"] = rng.normal(0.1, 0.1, channels)
        held[f"bn{layer + 1}/beta"] = rng.normal(0, 0.3, channels)
        held[f"bn{layer + 1}/moving_mean"] = rng.normal(0.1, 0.3, channels)
        held[f"bn{layer + 1}/moving_variance"] = rng.uniform(0.3, 2.0, channels)
    held["bn2/moving_variance"][:4] = 0.002  # where epsilon counts
    for name, (shape, bias) in DENSE_AND_BIASES.items():
        held[name] = rng.normal(0, np.sqrt(2 / shape[0]), shape)
        held[bias] = rng.normal(0.1, 0.3, shape[1])
    for name in ("W_c_1", "W_f_20", "bn1/beta"):
        for slot in ("Adam", "Adam_1"):
            held[f"{name}/{slot}"] = rng.normal(size=held[name].shape)
    held = {name: values.astype(np.float32) for name, values in held.items()}
    held["Optimization/beta1_power"] = np.array(0.0, np.float32)
    held["Network/vbp/Variable"] = np.ones((3, 3, 1, 1), np.float32)
    held["global_step"] = np.array(450000, np.int32)
    return held
