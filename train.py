"""The rl-zoo's training script with our algorithms: ``python train.py --algo crc --env dmc_pixels/cartpole-swingup-v0``."""

if __name__ == "__main__":  # processes of environments read this file too, and train nothing
    from sb3_crc.zoo import train

    train()
