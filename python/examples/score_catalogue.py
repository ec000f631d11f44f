"""Score a catalogue: Q, m and the power spectrum against the true shear field.

The catalogue comes from simulated images here; any e1 and e2 on the grid will do.
Run: python score_catalogue.py [--quick] [--out plot.png]
"""

import argparse

import shearq


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--quick", action="store_true", help="fewer galaxies")
    options.add_argument("--out", default="score_catalogue.png", help="the plot")
    arguments = options.parse_args()
    images, grid = (4, 30) if arguments.quick else (20, 60)

    simulation = shearq.simulate(set=8, images=images, grid=grid, seed=11)
    catalogues = [shearq.measure(image.stamps, image.psf) for image in simulation]
    # Divided by the mean response of all images.
    g1, g2 = shearq.concatenate(catalogues).shear()

    score = shearq.score(g1.reshape(images, -1), g2.reshape(images, -1), simulation.g1, simulation.g2)
    print(score)

    from matplotlib import pyplot

    figure, ax = pyplot.subplots(figsize=(5.5, 4.2), layout="constrained")
    score.plot(ax=ax)
    figure.savefig(arguments.out, dpi=150)


if __name__ == "__main__":
    main()
