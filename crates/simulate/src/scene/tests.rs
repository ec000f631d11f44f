use super::*;

fn simulator(change: impl Fn(&mut SceneSettings)) -> SceneSimulator {
    let mut settings = SceneSettings {
        side: 200,
        ..SceneSettings::default()
    };
    change(&mut settings);
    SceneSimulator::new(settings, Vec::new()).unwrap()
}

fn sources(simulator: &SceneSimulator, scene: u32) -> Vec<Source> {
    (0..simulator.objects())
        .filter_map(|index| simulator.source(scene, index))
        .collect()
}

fn light(simulator: &SceneSimulator, scene: u32) -> Array2<f32> {
    let side = simulator.settings().side;
    let mut image = Array2::zeros((side, side));
    let mut scratch = RenderScratch::new();
    for source in sources(simulator, scene) {
        simulator.draw(&source, &mut scratch).add_to(&mut image);
    }
    image
}

fn largest(values: impl Iterator<Item = f32>) -> f32 {
    values.fold(0.0, |a, b| a.max(b.abs()))
}

#[test]
fn stamps_have_all_of_the_light_of_their_sources() {
    let simulator = simulator(|settings| settings.star_density = 3.0);
    let side = simulator.settings().side;
    // One image of each source alone, as large as the scene.
    let whole = Renderer::new(side);
    let mut scratch = RenderScratch::new();
    let mut pixels = vec![0.0; side * side];
    let (mut checked, mut stars) = (0, 0);
    for source in sources(&simulator, 1) {
        let [x, y] = source.centre;
        // Centres in the image, as `render` requires; light of stamps that stick out must be cut off at the edges.
        if ![x, y]
            .iter()
            .all(|at| (0.0..side as f64 - 1.0).contains(at))
        {
            continue;
        }
        let mut image = Array2::zeros((side, side));
        simulator.draw(&source, &mut scratch).add_to(&mut image);
        whole.render(
            &source.light,
            &simulator.transformed(&simulator.psf),
            (x, y),
            &mut scratch,
            &mut pixels,
        );
        let peak = largest(pixels.iter().copied());
        let off = largest(image.iter().zip(&pixels).map(|(a, b)| a - b)) / peak;
        assert!(off < 1e-4, "{source:?}: {off}");
        checked += 1;
        stars += usize::from(source.is_star);
    }
    assert!(checked > 20 && stars > 0, "{checked} {stars}");
}

#[test]
fn a_shear_moves_galaxies_and_not_stars() {
    let versions = [None, Some([0.1, 0.0]), Some([0.0, 0.1])].map(|shear| {
        simulator(|settings| {
            settings.constant_shear = shear.or(Some([0.0; 2]));
            settings.star_density = 20.0;
        })
    });
    let norm = 1.0 / 0.99f64.sqrt();
    let mut stars = 0;
    for index in 0..versions[0].objects() {
        let [plain, first, second] = versions.each_ref().map(|own| own.source(1, index));
        let (Some(plain), Some(first), Some(second)) = (plain, first, second) else {
            continue;
        };
        let [x, y] = plain.centre.map(|at| at - 99.5);
        // [[1 + g1, g2], [g2, 1 − g1]]: written out, because the signs are what is tested.
        let expected = match plain.is_star {
            true => [[x, y]; 2],
            false => [
                [1.1 * norm * x, 0.9 * norm * y],
                [norm * (x + 0.1 * y), norm * (y + 0.1 * x)],
            ],
        };
        for (found, expected) in [first, second].iter().zip(expected) {
            for (found, expected) in found.centre.iter().zip(expected) {
                assert!((found - 99.5 - expected).abs() < 1e-9, "{plain:?}: {found}");
            }
        }
        stars += usize::from(plain.is_star);
        if plain.is_star {
            assert_eq!([first.observed, second.observed], [Shear::ZERO; 2]);
        } else if plain.intrinsic.modulus() < 0.2 {
            assert!(
                first.observed.e1 > plain.intrinsic.e1 && second.observed.e2 > plain.intrinsic.e2
            );
        }
        assert_eq!(
            [first.flux, second.flux].map(|flux| flux.to_bits()),
            [plain.flux.to_bits(); 2]
        );
    }
    assert!(stars > 3, "{stars}");
}

#[test]
fn the_image_of_a_shear_is_stretched_along_it() {
    // The light of round sources about the centre, which the second moments of the whole image have with their places.
    let moments = |shear: [f64; 2]| {
        let image = light(
            &simulator(|settings| settings.constant_shear = Some(shear)),
            3,
        );
        let (mut plus, mut cross) = (0.0, 0.0);
        for ((y, x), value) in image.indexed_iter() {
            let (x, y) = (x as f64 - 99.5, y as f64 - 99.5);
            // Within a circle, whose edge has no direction.
            if x * x + y * y < 80.0 * 80.0 {
                plus += f64::from(*value) * (x * x - y * y);
                cross += f64::from(*value) * 2.0 * x * y;
            }
        }
        [plus, cross]
    };
    for axis in 0..2 {
        let mut shear = [0.0; 2];
        shear[axis] = 0.1;
        let up = moments(shear);
        let down = moments(shear.map(|g| -g));
        assert!(up[axis] > down[axis], "{axis}: {up:?} {down:?}");
    }
}

#[test]
fn the_rotated_scene_is_the_scene_turned() {
    let scene = |rotated| {
        simulator(|settings| {
            settings.psf_shape = [0.0; 2];
            settings.constant_shear = Some([0.0; 2]);
            settings.rotated = rotated;
        })
    };
    let [plain, turned] = [false, true].map(|rotated| light(&scene(rotated), 2));
    let peak = largest(plain.iter().copied());
    let side = 200;
    // From x to y: (x, y) → (−y, x).
    let off = (0..side * side).map(|k| {
        let (y, x) = (k / side, k % side);
        turned[(x, side - 1 - y)] - plain[(y, x)]
    });
    assert!(largest(off) < 1e-4 * peak);
    assert!(largest(turned.iter().zip(&plain).map(|(a, b)| a - b)) > 0.1 * peak);
}

#[test]
fn versions_of_a_scene_have_the_same_noise() {
    let noise = |g: f64, rotated| {
        let simulator = simulator(|settings| {
            settings.constant_shear = Some([g, 0.0]);
            settings.rotated = rotated;
        });
        let mut image = Array2::zeros((200, 200));
        simulator.add_noise(4, 1, &mut image);
        image
    };
    let first = noise(0.02, false);
    assert_eq!(first, noise(-0.02, false));
    assert_eq!(first, noise(0.02, true));
    let mut opposite = Array2::zeros((200, 200));
    simulator(|settings| settings.negative_noise = true).add_noise(4, 1, &mut opposite);
    assert_eq!(first, -opposite);
}

#[test]
fn a_population_has_the_density_and_counts_stated() {
    let simulator = simulator(|settings| {
        settings.side = 3000;
        settings.counts_slope = 0.4;
    });
    let inside = |source: &Source| source.centre.iter().all(|at| (0.0..2999.0).contains(at));
    let found: Vec<Source> = (1..4)
        .flat_map(|scene| sources(&simulator, scene))
        .filter(inside)
        .collect();
    let expected = 3.0 * 75.0 * simulator.settings().area_arcmin2();
    let error = expected.sqrt();
    assert!(
        (found.len() as f64 - expected).abs() < 4.0 * error,
        "{} {expected}",
        found.len()
    );
    // N(> S/N) ∝ 1/(S/N) for a slope of 0.4.
    let above = |snr: f64| found.iter().filter(|own| own.snr > snr).count() as f64;
    for snr in [6.0, 30.0] {
        let share = (3.0 / snr - 3.0 / 400.0) / (1.0 - 3.0 / 400.0);
        let expected = found.len() as f64 * share;
        assert!(
            (above(snr) - expected).abs() < 4.0 * expected.sqrt(),
            "{snr}"
        );
    }
    let squares = found
        .iter()
        .map(|own| own.intrinsic.e1.powi(2))
        .sum::<f64>();
    let scatter = (squares / found.len() as f64).sqrt();
    // Rayleigh's distribution up to three of its scales: 0.25 less 1 %.
    assert!((scatter - 0.247).abs() < 0.01, "{scatter}");
}

#[test]
fn galaxies_of_a_lattice_do_not_blend() {
    let simulator = simulator(|settings| {
        settings.side = 600;
        settings.layout = Layout::Hexagonal;
        settings.density = 30.0;
        settings.constant_shear = Some([0.0; 2]);
    });
    let found = sources(&simulator, 1);
    let distance =
        |a: &Source, b: &Source| (a.centre[0] - b.centre[0]).hypot(a.centre[1] - b.centre[1]);
    // 300² px per arcmin² at 0.2 arcsec: √(2/√3 · 300²/30) = 58.9 px, less two offsets of up to 0.5·√2 px.
    for (k, own) in found.iter().enumerate() {
        let nearest = found.iter().enumerate().filter(|(other, _)| *other != k);
        let nearest = nearest
            .map(|(_, other)| distance(own, other))
            .fold(f64::MAX, f64::min);
        assert!((57.0..60.5).contains(&nearest), "{nearest}");
    }
    let inside = found
        .iter()
        .filter(|own| own.centre.iter().all(|at| (0.0..599.0).contains(at)));
    // 120 on 4 arcmin²; a row more or less along an edge.
    assert!((110..130).contains(&inside.count()));
}

#[test]
fn no_object_crosses_an_edge_beside_an_empty_border() {
    let all = |g: f64| {
        let simulator = simulator(|settings| {
            settings.side = 600;
            settings.border = 30;
            settings.star_density = 5.0;
            settings.constant_shear = Some([g, 0.0]);
        });
        let found: Vec<usize> = sources(&simulator, 1).iter().map(|own| own.index).collect();
        assert_eq!(found.len(), simulator.objects());
        (found, simulator.settings().area_arcmin2())
    };
    // 270 px · 0.05 are less than the border.
    assert_eq!(all(0.05), all(-0.05));
    // 540² px of 0.2 arcsec.
    assert!((all(0.0).1 - 3.24).abs() < 1e-12);
}

#[test]
fn settings_out_of_range_are_refused() {
    let refused = |change: &dyn Fn(&mut SceneSettings), words: &str| {
        let mut settings = SceneSettings::default();
        change(&mut settings);
        let error = settings.validate().unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    };
    refused(&|own| own.side = 10, "10 pixels a side");
    refused(&|own| own.border = 500, "leaves nothing");
    refused(&|own| own.pixel_arcsec = f64::NAN, "a pixel is NaN");
    refused(&|own| own.seeing_arcsec = 0.2, "1.00 pixels");
    refused(
        &|own| own.psf_shape = [0.0, f64::NAN],
        "the PSF's ellipticity",
    );
    refused(&|own| own.density = -1.0, "-1 galaxies");
    refused(&|own| own.star_density = 1e9, "stars per arcmin²");
    refused(&|own| own.snr = [5.0, 4.0], "5 to 4");
    refused(&|own| own.counts_slope = 0.0, "slope");
    refused(
        &|own| own.constant_shear = Some([0.2, 0.0]),
        "constant shear",
    );
}

#[test]
fn a_psf_that_varies_has_the_terms_of_its_model() {
    let simulator = simulator(|settings| settings.psf_gradient = [0.05, 0.03]);
    let terms = simulator.star_terms();
    let side = STAR + 1;
    // From the middle, in units of the side.
    let [u, v] = [0.4, -0.3];
    let factors = [1.0, u, u * u, v, u * v, v * v];
    let own = simulator.at_place([0.8, -0.6]).stamp(side);
    let middle = simulator.at_place([0.0, 0.0]).stamp(side);
    let (mut error, mut change) = (0.0f64, 0.0f64);
    for (at, ((y, x), value)) in own.indexed_iter().enumerate() {
        let model = (0..6).map(|k| factors[k] * terms[k * side * side + at]);
        error = error.max((model.sum::<f64>() - value).abs());
        change = change.max((middle[[y, x]] - value).abs());
    }
    // Terms of third order are missing.
    assert!(error < 2e-3 * change, "{error} {change}");
}

#[test]
fn objects_are_behind_the_psf_of_their_place() {
    let varying = simulator(|settings| {
        settings.psf_gradient = [0.2, 0.0];
        settings.star_density = 3.0;
    });
    let constant = simulator(|settings| settings.star_density = 3.0);
    let mut scratch = RenderScratch::new();
    let mut compared = 0;
    for source in sources(&varying, 1).iter().filter(|source| source.is_star) {
        let mut peak = |simulator: &SceneSimulator| {
            let stamp = simulator.draw(source, &mut scratch);
            largest(stamp.pixels.into_iter())
        };
        let (own, other) = (peak(&varying), peak(&constant));
        // Broader to the right of the middle, with the same light.
        if (source.centre[0] - 99.5).abs() > 10.0 {
            assert_eq!(own < other, source.centre[0] > 99.5, "{source:?}");
            compared += 1;
        }
    }
    assert!(compared > 1, "{compared}");
}

#[test]
fn an_epoch_is_the_scene_turned_and_moved() {
    let simulator = simulator(|settings| {
        settings.psf_shape = [0.0; 2];
        settings.constant_shear = Some([0.05, 0.02]);
        settings.epochs = 2;
    });
    let view = View {
        radians: 0.5 * std::f64::consts::PI,
        dither: [3.0, -7.0],
    };
    let mut scratch = RenderScratch::new();
    let mut image = |view| {
        let mut image = Array2::zeros((200, 200));
        for source in sources(&simulator, 2) {
            if let Some(own) = simulator.seen(&source, view) {
                simulator.draw(&own, &mut scratch).add_to(&mut image);
            }
        }
        image
    };
    let (plain, turned) = (image(View::default()), image(view));
    let peak = largest(plain.iter().copied());
    // From x to y: (x, y) → (199 − y + 3, x − 7).
    let places = (10..190usize).flat_map(|y| (10..190usize).map(move |x| (x, y)));
    let off = places.map(|(x, y)| turned[(x - 7, 202 - y)] - plain[(y, x)]);
    let off = largest(off) / peak;
    assert!(off < 1e-4, "{off}");
    let settings = simulator.settings();
    assert_eq!(settings.view(2, 1), View::default());
    assert_ne!(settings.view(2, 2), settings.view(3, 2));
}

#[test]
fn light_has_the_noise_of_its_electrons() {
    let noise = |light: f32, gain| {
        let simulator = simulator(|settings| settings.gain = gain);
        let mut image = Array2::from_elem((200, 200), light);
        simulator.add_noise(1, 1, &mut image);
        image.mapv(|value| f64::from(value - light)).std(0.0)
    };
    // Of 40,000 numbers: 0.35 % is the error of one.
    for (light, gain, sigma) in [
        (30.0, Some(10.0), 2.0),
        (-5.0, Some(10.0), 1.0),
        (30.0, None, 1.0),
    ] {
        let found = noise(light, gain);
        assert!(
            (found / (sigma * NOISE_SIGMA) - 1.0).abs() < 0.015,
            "{light}: {found}"
        );
    }
}
