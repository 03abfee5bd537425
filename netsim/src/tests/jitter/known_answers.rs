//! Known answers: quantiles and first delays of each distribution.
//!
//! An independent implementation gives the same values: distributions by scipy 1.17 (`scipy.stats`), draws by
//! Python integers, the path by stepping from cell to cell.

use super::{SEED, correlated, delays, independent, laws};
use crate::DelayLaw;

/// Probabilities of the quantiles.
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
            4_181_481, 3_978_347, 3_783_644, 3_595_993, 3_416_542, 3_243_695, 3_078_627, 2_919_886,
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
            46_498_247, 46_098_396, 45_714_400, 45_347_272, 44_998_195, 44_667_508, 44_355_691, 44_063_295,
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
            45_938_799, 45_846_684, 45_761_729, 45_683_575, 45_611_861, 45_546_232, 45_573_627, 45_524_190,
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
            23_162_064, 23_661_601, 24_168_793, 24_683_610, 25_206_108, 25_736_340, 26_274_358, 26_820_215,
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
            45_550_662, 45_386_724, 45_230_389, 45_081_457, 44_939_737, 44_805_092, 44_677_296, 44_756_855,
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
            31_568_604, 32_008_229, 32_453_993, 32_905_938, 33_364_213, 33_290_571, 32_833_349, 32_382_355,
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
            46_174_852, 46_181_858, 46_189_754, 46_198_594, 46_208_507, 46_219_548, 46_231_864, 46_245_518,
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
            46_504_065, 46_460_698, 46_171_796, 45_906_592, 45_664_324, 45_444_611, 45_245_730, 45_066_722,
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
            // The reference deviation of the table is a sum over 8e5 steps.
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
