"""Values of LPIPS and FID with made-up weights, by PyTorch and the packages lpips and pytorch-fid.

    pip install torch torchvision lpips pytorch-fid
    python networks.py > values.json

The weights follow from their tensor's name and place alone, so that none need storing: tests/evaluate.rs makes the same.
"""

import json

import lpips
import numpy as np
import torch
from pytorch_fid import inception
from pytorch_fid.fid_score import calculate_frechet_distance


def uniform(name, count):
    """Float32 numbers in [0, 1) of 24 bits."""
    seed = np.uint32(2166136261)
    for byte in name.encode():
        seed = np.uint32((int(seed) ^ byte) * 16777619 & 0xFFFFFFFF)
    with np.errstate(over="ignore"):
        h = np.arange(count, dtype=np.uint32) * np.uint32(2654435761) + seed
        h ^= h >> np.uint32(16)
        h *= np.uint32(0x7FEB352D)
        h ^= h >> np.uint32(15)
        h *= np.uint32(0x846CA68B)
        h ^= h >> np.uint32(16)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def tensor(name, shape):
    values = uniform(name, int(np.prod(shape)))
    one = np.float32(1)
    if name.startswith("lin") or name.endswith("running_var"):
        values = values + np.float32(0.5)
    elif name.endswith("bn.weight"):
        values = values * np.float32(0.25) + one
    elif len(shape) == 4:
        fan_in = shape[1] * shape[2] * shape[3]
        values = (values * np.float32(2) - one) * np.float32(np.sqrt(6.0 / fan_in))
    else:
        values = (values * np.float32(2) - one) * np.float32(0.125)
    return torch.from_numpy(values.astype(np.float32).reshape(shape))


def picture(k, width=75, height=53):
    y, x, c = np.meshgrid(np.arange(height), np.arange(width), np.arange(3), indexing="ij")
    return ((x * 7 + y * 13 + c * 50 + (x * y) % 31 * 5 + k * 37 + k * x // 3) % 256).astype(np.uint8)


def batch(image, unit):
    values = torch.from_numpy(image.astype(np.float32) / np.float32(255)).permute(2, 0, 1)[None]
    return values if unit else 2 * values - 1


MASK = np.zeros((53, 75), bool)
MASK[10:45, 20:62] = True
MASK[10:20, 20:30] = False
BOX = np.s_[10:45, 20:62]


def distances(net):
    model = lpips.LPIPS(net=net, pretrained=False, pnet_rand=True, spatial=True, verbose=False).eval()
    whole = lpips.LPIPS(net=net, pretrained=False, pnet_rand=True, spatial=False, verbose=False).eval()
    state = {}
    for name, old in model.state_dict().items():
        if name.startswith("net.slice"):
            state[name] = tensor("features." + name.split(".", 2)[2], tuple(old.shape))
        elif name.startswith("lin"):
            number = name.split(".")[1] if name.startswith("lins.") else name[3]
            state[name] = tensor(f"lin{number}.model.1.weight", tuple(old.shape))
        else:
            state[name] = old
    model.load_state_dict(state)
    whole.load_state_dict(state)
    out = {}
    for unit in [False, True]:
        a, b = (batch(picture(k), unit) for k in [1, 2])
        mapped = model(a, b)[0, 0].numpy()
        cut = [v[:, :, BOX[0], BOX[1]] for v in [a, b]]
        out["unit" if unit else "signed"] = {
            "full": whole(a, b).item(),
            "mask": float(mapped[MASK].mean(dtype=np.float64)),
            "box": whole(*cut).item(),
        }
    return out


def frechet():
    net = inception._inception_v3(num_classes=1008, aux_logits=False, weights=None)
    net.Mixed_5b = inception.FIDInceptionA(192, pool_features=32)
    net.Mixed_5c = inception.FIDInceptionA(256, pool_features=64)
    net.Mixed_5d = inception.FIDInceptionA(288, pool_features=64)
    net.Mixed_6b = inception.FIDInceptionC(768, channels_7x7=128)
    net.Mixed_6c = inception.FIDInceptionC(768, channels_7x7=160)
    net.Mixed_6d = inception.FIDInceptionC(768, channels_7x7=160)
    net.Mixed_6e = inception.FIDInceptionC(768, channels_7x7=192)
    net.Mixed_7b = inception.FIDInceptionE_1(1280)
    net.Mixed_7c = inception.FIDInceptionE_2(2048)
    state = net.state_dict()
    state = {k: tensor(k, tuple(v.shape)) if v.dtype == torch.float32 else v for k, v in state.items()}
    net.load_state_dict(state)
    model = inception.InceptionV3.__new__(inception.InceptionV3)
    torch.nn.Module.__init__(model)
    model.resize_input, model.normalize_input = True, True
    model.output_blocks, model.last_needed_block = [3], 3
    pool = torch.nn.MaxPool2d(kernel_size=3, stride=2)
    model.blocks = torch.nn.ModuleList([
        torch.nn.Sequential(net.Conv2d_1a_3x3, net.Conv2d_2a_3x3, net.Conv2d_2b_3x3, pool),
        torch.nn.Sequential(net.Conv2d_3b_1x1, net.Conv2d_4a_3x3, pool),
        torch.nn.Sequential(net.Mixed_5b, net.Mixed_5c, net.Mixed_5d, net.Mixed_6a, net.Mixed_6b, net.Mixed_6c,
                            net.Mixed_6d, net.Mixed_6e),
        torch.nn.Sequential(net.Mixed_7a, net.Mixed_7b, net.Mixed_7c, torch.nn.AdaptiveAvgPool2d((1, 1))),
    ])
    model.eval()
    sets = [[model(batch(picture(k), True))[0][0, :, 0, 0].numpy().astype(np.float64) for k in ks]
            for ks in ([1, 2, 3], [4, 5, 6])]
    moments = [(np.mean(s, axis=0), np.cov(np.array(s), rowvar=False)) for s in sets]
    return {
        "features": [float(v) for v in sets[0][0][::64]],
        "distance": float(calculate_frechet_distance(*moments[0], *moments[1])),
    }


with torch.no_grad():
    print(json.dumps({"vgg": distances("vgg"), "alex": distances("alex"), "fid": frechet()}, indent=2))
