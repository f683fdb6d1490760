"""``python -m sb3_crc.zoo <command> flags...``"""

from sb3_crc.zoo.commands import main

if __name__ == "__main__":
    main()
