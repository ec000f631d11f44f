"""A toy code that measures shapes. Galaxies and noise have fixed seeds, so that a change of the code is all that differs."""

import random

SHEAR, M = 0.02, 0.010


def measured(shear, m=M):
    """Ellipticities of 5,000 galaxies under a shear: shape, response to the shear, and noise of the measurement."""
    shapes, noise = random.Random(1), random.Random(2 if shear > 0 else 3)
    for _ in range(5000):
        yield [shapes.gauss(0, 0.2) + (1 + m) * shear + noise.gauss(0, 0.05) for _ in range(2)]


def write(name, shear):
    with open(name, "w") as file:
        print("id,e1,e2,g1,g2", file=file)
        for number, (e1, e2) in enumerate(measured(shear)):
            print(f"{number},{e1:.7f},{e2:.7f},{shear},{shear}", file=file)


if __name__ == "__main__":
    write("plus.csv", SHEAR)
    write("minus.csv", -SHEAR)
