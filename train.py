"""The rl-zoo's training script with our algorithms: ``python train.py --algo crc --env dmc_pixels/cartpole-swingup-v0``."""

from sb3_crc.zoo import train

if __name__ == "__main__":
    train()
