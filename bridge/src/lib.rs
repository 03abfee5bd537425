//! The bridge: wire format, link, ladder, coupling and endpoints as pure state machines, and their two runners.
//!
//! [`MasterEndpoint`] and [`SlaveEndpoint`] own no socket, thread or clock. [`run_virtual`] and [`live`] (UDP) both
//! step a [`Side`], so a simulation runs the live code.

mod buttons;
mod command;
pub mod coupling;
mod driven;
mod endpoint;
mod fault_text;
mod gripper;
mod kind;
pub mod ladder;
mod link;
pub mod live;
mod live_socket;
mod local;
mod pace;
pub mod path;
mod plant;
pub mod playout;
mod port;
mod record;
pub mod recorder;
mod ring;
pub mod scene;
pub mod session;
mod side;
pub mod telemetry;
mod virtual_time;
pub mod wire;

pub use buttons::{ButtonError, ButtonSettings, ButtonWord};
pub use command::OperatorCommand;
pub use driven::{DrivenSlave, DrivenSlaveError, SlaveOrder};
pub use endpoint::{
    CarriedState, EndpointError, Exchange, HandInput, MasterEndpoint, MasterReading, MasterRotationSettings,
    MasterSettings, MasterTick, SideCounts, SlaveEndpoint, SlaveReading, SlaveRotationSettings,
    SlaveSettings, SlaveTick, TriggerError, TriggerSettings,
};
pub use fault_text::{FaultText, MAX_FAULT_TEXT, PIECE, PIECES, ReceivedText, SentText, TextPiece};
pub use gripper::{GripperOrder, HeldTrigger, SlaveGripper, Trigger};
pub use kind::SideKind;
pub use ladder::{
    AlignmentState, Clutch, ClutchError, ClutchOperator, Diagnosis, Explanation, FlightEntry, FlightRecorder,
    History, Ladder, LadderError, LadderInput, LadderInputs, LadderSettings, LadderState, LinkView, Observed,
    PeerCause, PeerFrame, PeerReport, Reason, Remedy, Step, Transition,
};
pub use link::{FrameLink, LinkStatistics, LinkTime, RejectReason, Status};
pub use local::{DelayLine, LocalLoop, LocalTick, Rendering, SceneRendering, TrueWatch, Watch, Watched};
pub use pace::TickTime;
pub use path::{PathReport, PeerPath};
pub use plant::{
    DrivenMaster, MasterPlant, ModelArm, ModelPlant, RotationTruth, SlavePlant, ToolMotion, Truth,
    TurningMaster,
};
pub use port::{CouplingMessage, MAX_ENERGY_J, PortEnergy, PortState};
pub use record::{
    Column, FingerTick, MasterRecord, MasterRotation, MasterTurn, SlaveRecord, SlaveRotation, SlaveTurn,
    Trace, WithTriggerFeedback,
};
pub use side::{MasterSide, Side, SlaveSide};
pub use virtual_time::{Event, LoopCounts, VirtualCounts, VirtualError, VirtualSettings, run_virtual};
