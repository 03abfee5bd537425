//! Known answers: quantiles of each law, and its first delays.
//!
//! All were computed by an independent implementation as well: laws by scipy 1.17 (`scipy.stats`), draws by Python
//! integers, the path by stepping from cell to cell.

use super::{SEED, correlated, delays, independent, laws};
use crate::DelayLaw;

/// Share of packets that stay below, for the quantiles.
const SHARES: [f64; 5] = [1e-6, 0.01, 0.5, 0.99, 0.999_999];

struct Answers {
    name: &'static str,
    quantiles_s: [f64; 5],
    independent_ns: [u64; 8],
    correlated_ns: [u64; 8],
}

const ANSWERS: [Answers; 9] = [
    Answers {
        name: "normal",
        quantiles_s: [
            0.026_232_878_455_885_508,
            0.038_368_260_629_795_8,
            0.05,
            0.061_631_739_370_204_205,
            0.073_767_121_544_085_43,
        ],
        independent_ns: [
            42_004_129, 49_491_060, 53_721_752, 49_008_727, 47_465_700, 51_986_829, 61_116_012, 48_075_572,
        ],
        correlated_ns: [
            42_809_251, 43_162_797, 43_516_344, 43_497_079, 43_143_533, 43_484_206, 43_837_752, 44_191_298,
        ],
    },
    Answers {
        name: "normal, cut",
        quantiles_s: [
            9.410_602_515_302_902e-8,
            0.000_937_367_602_371_452_8,
            0.044_144_125_893_492_966,
            0.148_705_529_951_613_12,
            0.269_375_647_494_255_9,
        ],
        independent_ns: [
            5_063_867,
            40_395_330,
            74_655_963,
            36_964_636,
            26_897_930,
            59_852_703,
            143_692_509,
            30_700_262,
        ],
        correlated_ns: [
            2_889_912, 3_052_814, 3_223_219, 3_401_319, 3_586_842, 3_781_030, 3_982_903, 4_193_659,
        ],
    },
    Answers {
        name: "uniform",
        quantiles_s: [
            0.041_339_763_282_663_69,
            0.041_512_951_042_912_506,
            0.05,
            0.058_487_048_957_087_506,
            0.058_660_236_717_336_31,
        ],
        independent_ns: [
            42_290_508, 49_297_877, 54_705_393, 48_639_013, 46_642_043, 52_675_148, 58_433_331, 47_404_733,
        ],
        correlated_ns: [
            42_642_121, 42_824_907, 43_026_027, 43_014_653, 42_814_450, 43_007_057, 43_225_757, 43_464_491,
        ],
    },
    Answers {
        name: "exponential",
        quantiles_s: [
            0.045_000_005_000_002_51,
            0.045_050_251_679_267_51,
            0.048_465_735_902_799_734,
            0.068_025_850_929_940_46,
            0.114_077_552_789_677_6,
        ],
        independent_ns: [
            45_282_308, 48_075_980, 52_384_780, 47_735_930, 46_827_356, 50_313_125, 66_675_363, 47_155_175,
        ],
        correlated_ns: [
            45_390_871, 45_448_257, 45_512_161, 45_508_529, 45_444_955, 45_506_103, 45_576_449, 45_654_393,
        ],
    },
    Answers {
        name: "gamma",
        quantiles_s: [
            0.000_887_404_891_982_763_5,
            0.010_290_608_579_317_316,
            0.045_900_759_360_636_215,
            0.125_563_968_935_395_2,
            0.266_880_712_040_486_8,
        ],
        independent_ns: [
            17_628_641,
            43_524_109,
            65_956_537,
            41_349_680,
            34_891_238,
            56_009_777,
            120_930_907,
            37_354_566,
        ],
        correlated_ns: [
            17_753_602, 18_180_973, 18_615_686, 19_057_805, 19_507_662, 19_965_122, 20_430_181, 20_902_901,
        ],
    },
    Answers {
        name: "gamma, shape 2",
        quantiles_s: [
            0.042_933_934_546_686_04,
            0.043_454_152_509_186_98,
            0.048_862_784_877_258_585,
            0.066_399_051_004_045_35,
            0.101_931_409_730_584_84,
        ],
        independent_ns: [
            44_253_618, 48_416_490, 52_885_748, 48_015_199, 46_867_853, 50_839_300, 65_296_794, 47_297_067,
        ],
        correlated_ns: [
            44_516_929, 44_644_347, 44_779_200, 44_771_684, 44_637_202, 44_766_664, 44_908_584, 45_058_535,
        ],
    },
    Answers {
        name: "lognormal",
        quantiles_s: [
            0.019_125_720_249_905_723,
            0.030_929_103_358_524_404,
            0.049_029_033_784_546_01,
            0.077_721_171_738_514_92,
            0.125_686_568_789_755_1,
        ],
        independent_ns: [
            35_719_973, 48_050_588, 56_816_424, 47_141_314, 44_346_473, 53_043_262, 76_149_748, 45_430_746,
        ],
        correlated_ns: [
            36_877_385, 37_397_460, 37_924_789, 37_895_893, 37_368_923, 37_876_586, 38_410_690, 38_952_374,
        ],
    },
    Answers {
        name: "pareto",
        quantiles_s: [
            0.046_127_019_752_181_12,
            0.046_158_187_798_051_74,
            0.048_430_641_663_840_41,
            0.069_549_060_536_166_84,
            0.276_165_680_864_326_86,
        ],
        independent_ns: [
            46_303_007, 48_155_373, 51_450_816, 47_918_679, 47_301_834, 49_795_450, 67_502_693, 47_521_815,
        ],
        correlated_ns: [
            46_371_190, 46_407_352, 46_447_719, 46_445_422, 46_405_269, 46_443_888, 46_488_432, 46_537_936,
        ],
    },
    Answers {
        name: "table",
        quantiles_s: [
            0.043_793_573_380_814_285,
            0.043_827_265_285_078_62,
            0.048_864_018_066_229_26,
            0.060_447_255_745_760_71,
            0.060_748_418_787_737_596,
        ],
        independent_ns: [
            44_016_341, 48_199_084, 54_477_006, 47_615_599, 46_088_642, 51_808_267, 60_353_050, 46_628_774,
        ],
        correlated_ns: [
            44_119_604, 44_177_969, 44_245_782, 44_241_811, 44_174_556, 44_239_160, 44_316_674, 44_406_191,
        ],
    },
];

#[test]
fn quantiles_agree_with_an_independent_implementation() {
    for ((name, settings), answers) in laws().iter().zip(&ANSWERS) {
        assert_eq!(*name, answers.name);
        let law = DelayLaw::new(settings).unwrap();
        assert_eq!((law.mean_s(), law.sigma_s()), (settings.delay_s, settings.jitter_s));
        for (share, answer) in SHARES.iter().zip(answers.quantiles_s) {
            let seen = law.quantile_s(*share);
            // The table's own deviation was found by summing over 8e5 steps.
            let tolerance = if *name == "table" { 1e-7 } else { 1e-9 };
            assert!((seen - answer).abs() < tolerance * law.sigma_s(), "{name} {share}: {seen} {answer}");
        }
        assert!(law.quantile_s(-0.1).is_nan() && law.quantile_s(f64::NAN).is_nan());
    }
}

#[test]
fn first_delays_are_the_same_on_every_platform() {
    assert_eq!(SEED, 0x5EED_0000_0000_0004);
    for ((name, settings), answers) in laws().iter().zip(&ANSWERS) {
        assert_eq!(delays(&independent(settings), 1000, 8), answers.independent_ns, "{name}");
        assert_eq!(delays(&correlated(settings, 0.1), 1000, 8), answers.correlated_ns, "{name}");
    }
}
