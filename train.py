"""Train or play an agent: `python train.py task=HumanoidAMP [key=value ...]`.

The same as `python -m isaacgymenvs_lite.train`, which an installed package offers.
"""

from isaacgymenvs_lite.train import main

if __name__ == "__main__":
    main()
