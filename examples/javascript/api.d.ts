// Written by docs/generators/script_types.py.

/** Every method by name: its parameters and its result. */
export interface Methods {
  /** Introduce the client; returns what the daemon drives. */
  hello: { params: HelloParams; result: HelloResult };
  /** Show daemon, amplifiers and contacts. */
  status: { params: Empty; result: StatusResult };
  /** Switch the high voltage on. Touches are felt until the lease expires. */
  arm: { params: ArmParams; result: ArmResult };
  /** Extend the lease. */
  renew: { params: RenewParams; result: RenewResult };
  /** Ramp to silence, then switch the high voltage off. Any client may. While a link is lost it stops all amplifiers. */
  disarm: { params: DisarmParams; result: Empty };
  /** Quick-stop all amplifiers, latched until clear. Not an emergency stop. Any client can stop, at any time; error 1006 unless every amplifier is confirmed silent. */
  stop: { params: RequestedBy; result: StopResult };
  /** Clear a stop, or a fault that no longer exists. Stays disarmed. */
  clear: { params: ClearParams; result: Empty };
  /** Report all fingers of a touch source of this client. */
  touch: { params: TouchParams; result: Empty };
  /** Use one of the daemon's layouts. Of resting fingers, what ends by itself and what a program plays goes on to its end; what lasts follows the new layout at once. */
  layout: { params: LayoutParams; result: LayoutResult };
  /** Read the daemon's files again and apply their layouts. Any other change is refused, and needs a restart. */
  reload: { params: Empty; result: ReloadResult };
  /** List the effects. */
  effects: { params: Empty; result: EffectsResult };
  /** Play an effect, or points, at a finger; only while armed. */
  play: { params: PlayParams; result: Empty };
  /** Set or show the strength of a source, client or region. The name is that of a touch source, a client or a region; the status shows all strengths. Active effects are faded to it within 100 ms. */
  strength: { params: StrengthParams; result: StrengthResult };
  /** Receive notifications of topics. */
  subscribe: { params: SubscribeParams; result: Empty };
  /** Receive no more notifications of topics. */
  unsubscribe: { params: UnsubscribeParams; result: Empty };
}
export type Method = keyof Methods;

/** The data of every topic of event notifications. */
export interface Topics {
  /** every change of state or epoch, with its cause */
  state: StateEvent;
  /** fingers touched, moved or lifted */
  contacts: ContactsEvent;
  /** what plays now, as the amplifiers confirmed it */
  pattern: PatternEvent;
  /** nothing plays now, and why */
  silence: SilenceEvent;
  /** status of the amplifiers, at rate_hz */
  amplifiers: AmplifiersEvent;
  /** latency from touch to command, at rate_hz */
  latency: LatencyEvent;
  /** log records from level info, without those of `state` and `link` */
  log: LogEvent;
  /** links to amplifiers that were degraded, lost or reopened */
  link: LinkEvent;
  /** another surface layout is in use, or it was replaced */
  layout: LayoutEvent;
  /** touch inputs that are missing, mute or back; rejected touches, each second */
  inputs: InputsEvent;
  /** strengths of sources, clients and regions, at rate_hz */
  strength: StrengthResult;
}
export type Topic = keyof Topics;

/** An event notification of any topic. */
export type Event = {
  [T in Topic]: { topic: T; time_s: number; lost: number; data: Topics[T] };
}[Topic];

/** A method's parameters as arguments: they may be left out where all of them may. */
export type Arguments<M extends Method> = {} extends Methods[M]["params"]
  ? [params?: Methods[M]["params"]]
  : [params: Methods[M]["params"]];

/** Name of the client, for the log. */
export interface HelloParams {
  client: string;
}

/** Rig, table and layout of the daemon; constant while it runs, except for the layout. */
export interface HelloResult {
  /** major.minor; major versions are incompatible */
  api_version: string;
  software_version: string;
  rig: RigSummary;
  table: TableSummary;
  /** the rig file, from which vibration fields can be computed */
  rig_text: string;
  /** the surface layout; null without one */
  layout: Record<string, unknown> | null;
  /** of amplifiers, for a page: name, unit, decimals, by the key in their status */
  readings?: Record<string, [string, string, number]>;
}

/** An empty object: no parameters, or no result. */
export interface Empty {
}

/** State of the daemon, the amplifiers and the plate. */
export interface StatusResult {
  /** why it is so */
  cause: string;
  /** what to do about it; null if nothing */
  remedy: string | null;
  /** in order of arrival, newest last */
  contacts: Array<ContactStatus>;
  /** of the newest content, by ERA, without silent ones */
  drive: Record<string, PlayedTone>;
  /** what plays of each content, by layer, then as `drive`; they add up */
  layers?: Record<string, Record<string, PlayedTone>>;
  /** felt contrast, target over loudest quiet finger, that nine of ten plates within the rig's uncertainty give; null for a single finger */
  promised_contrast_db?: number | null;
  /** the same, nominal */
  predicted_contrast_db?: number | null;
  predicted_level_db_sl: number | null;
  /** gain in dB by name, 0 where none is set: of the inputs of the configuration, sources that had fingers, clients that are connected, regions of the layout in use, and what else is set */
  strengths?: Record<string, number>;
  /** time of this response on CLOCK_MONOTONIC */
  time_s: number;
  /** the same time on the wall clock */
  unix_time_s: number;
  state: "NOT_READY" | "SWITCH_ON_DISABLED" | "READY_TO_SWITCH_ON" | "SWITCHED_ON" | "OPERATION_ENABLED" | "QUICK_STOP_ACTIVE" | "FAULT_REACTION_ACTIVE" | "FAULT" | "COMM_LOST";
  /** the state in a word for people */
  word?: string;
  /** rises with every change of state, stop, fault and loss; begins by chance */
  epoch: number;
  /** whether lost amplifiers may still be playing */
  assume_energised: boolean;
  /** how long a link has been lost; null if all are up */
  lost_for_s: number | null;
  /** time without heartbeats after which an armed amplifier silences itself */
  watchdog_s: number;
  armed_by: string | null;
  lease_left_s: number | null;
  /** why nothing plays although armed */
  silence_reason?: string | null;
  amplifiers: Array<AmplifierStatus>;
  /** of touches: a finger came, moved or pressed harder or less */
  latency_ms: LatencySummary;
  /** of lifts, and of all that changes without a touch, as an effect's end */
  lift_latency_ms?: LatencySummary | null;
  /** number by reason, of all sources */
  rejected_touches: Record<string, number>;
  /** the newest of each reason: what came, and from where */
  rejected_examples?: Record<string, string>;
  /** touch inputs of the configuration */
  inputs?: Array<TouchInputStatus>;
  /** short vibrations that came too late to be felt; the plate plays on */
  clicks_too_late?: number;
  /** notifications that clients were too slow to read, by topic */
  lost_events?: Record<string, number>;
  /** name of the layout in use; null without any */
  layout?: string | null;
  /** names that `layout` accepts */
  layouts?: Array<string>;
  /** why answers take longer than they need */
  slow_reason?: string | null;
  /** name of the rig's threshold set, to which levels in dB SL are relative */
  threshold?: string | null;
  uptime_s: number;
}

/** Who arms, and how long the lease lasts without renewal. */
export interface ArmParams {
  owner: string;
  lease_s?: number;
}

/** The lease, to be renewed within lease_s. */
export interface ArmResult {
  lease_s: number;
  lease: string;
}

/** The lease that `arm` returned. */
export interface RenewParams {
  lease: string;
}

/** Time until the lease expires. */
export interface RenewResult {
  lease_s: number;
}

/** Whose lease to end. */
export interface DisarmParams {
  client?: string | null;
  /** disarm only while this lease lasts; null: whoever armed */
  lease?: string | null;
}

/** Who requests it, for the log, if it is not the connection's own client. */
export interface RequestedBy {
  client?: string | null;
}

/** Every amplifier is confirmed silent. */
export interface StopResult {
  /** rises with every change of state, stop, fault and loss; begins by chance */
  epoch: number;
  /** by name */
  amplifiers?: Record<string, AmplifierSilence>;
}

/** What is acknowledged; a later stop, fault or loss is not. */
export interface ClearParams {
  client?: string | null;
  /** as last seen in a status, stop or state event; null: whatever is latched */
  epoch?: number | null;
}

/** All fingers of one source of this client; valid for 150 ms, to be repeated. */
export interface TouchParams {
  source: string;
  touches: Array<TouchPoint>;
}

/** The layout to use. */
export interface LayoutParams {
  /** one of `layouts` in the status */
  name: string;
}

/** The layout in use, and all that may be used. */
export interface LayoutResult {
  layout: string;
  layouts: Array<string>;
}

/** What came of reading the daemon's files again. */
export interface ReloadResult {
  /** whether they are in use now; else all is as before */
  reloaded: boolean;
  /** what has changed; if refused, why */
  reasons: Array<string>;
}

/** The effects that `play` accepts. */
export interface EffectsResult {
  effects: Array<EffectDescription>;
}

/** Play an effect, or points, at the finger nearest to a position; they end when it lifts. */
export interface PlayParams {
  /** of the layout, or a named content; null where points or taps are given */
  effect?: string | null;
  /** a finger must be within 20 mm of the position */
  x_m: number;
  y_m: number;
  /** from -20; at most, and by default, the effect's own; of points by default 20, at most the highest of the layout */
  level_db_sl?: number | null;
  /** of what lasts: `[time_s, intensity, sharpness]` in order of time, 0 to 60 s, 0 to 1 */
  points?: Array<Array<number>>;
  /** short ones beside it, in the same way */
  taps?: Array<Array<number>>;
  /** whether points or a file begin anew at their end */
  loop?: boolean;
}

/** A touch source, client or region and its gain; without a gain nothing is set. */
export interface StrengthParams {
  /** of an input, a sender there, a source, a client or a region */
  name: string;
  /** of all that it brings or has, 0 for what layout and limits allow */
  gain_db?: number | null;
}

/** The strengths of touch sources, clients and regions that are known. */
export interface StrengthResult {
  /** gain in dB by name, 0 where none is set: of the inputs of the configuration, sources that had fingers, clients that are connected, regions of the layout in use, and what else is set */
  strengths?: Record<string, number>;
}

/** Topics to receive, and the rate of the periodic ones. */
export interface SubscribeParams {
  topics: Array<"state" | "contacts" | "pattern" | "silence" | "amplifiers" | "latency" | "log" | "link" | "layout" | "inputs" | "strength">;
  /** of amplifiers and latency; default 10 */
  rate_hz?: number | null;
}

/** Topics to receive no longer. */
export interface UnsubscribeParams {
  topics: Array<"state" | "contacts" | "pattern" | "silence" | "amplifiers" | "latency" | "log" | "link" | "layout" | "inputs" | "strength">;
}

/** The daemon changed its state. */
export interface StateEvent {
  /** why it is so */
  cause: string;
  /** what to do about it; null if nothing */
  remedy: string | null;
  old: "NOT_READY" | "SWITCH_ON_DISABLED" | "READY_TO_SWITCH_ON" | "SWITCHED_ON" | "OPERATION_ENABLED" | "QUICK_STOP_ACTIVE" | "FAULT_REACTION_ACTIVE" | "FAULT" | "COMM_LOST";
  new: "NOT_READY" | "SWITCH_ON_DISABLED" | "READY_TO_SWITCH_ON" | "SWITCHED_ON" | "OPERATION_ENABLED" | "QUICK_STOP_ACTIVE" | "FAULT_REACTION_ACTIVE" | "FAULT" | "COMM_LOST";
  /** the new state in a word for people */
  word?: string;
  /** rises with every change of state, stop, fault and loss; begins by chance */
  epoch: number;
}

/** All contacts after a change, before a pattern is selected for them. */
export interface ContactsEvent {
  contacts: Array<ContactStatus>;
}

/** A pattern that the amplifiers confirmed. */
export interface PatternEvent {
  /** in order of arrival, newest last */
  contacts: Array<ContactStatus>;
  /** of the newest content, by ERA, without silent ones */
  drive: Record<string, PlayedTone>;
  /** what plays of each content, by layer, then as `drive`; they add up */
  layers?: Record<string, Record<string, PlayedTone>>;
  /** felt contrast, target over loudest quiet finger, that nine of ten plates within the rig's uncertainty give; null for a single finger */
  promised_contrast_db?: number | null;
  /** the same, nominal */
  predicted_contrast_db?: number | null;
  predicted_level_db_sl: number | null;
  /** from the touch to the last byte of the command; null if none was needed */
  latency_ms: number | null;
}

/** No channel is driven; if a link is lost (see the state), as far as known. */
export interface SilenceEvent {
  contacts: Array<ContactStatus>;
  reason: string;
  /** null if no command was needed */
  latency_ms: number | null;
}

/** All amplifiers, at the subscribed rate. */
export interface AmplifiersEvent {
  amplifiers: Array<AmplifierStatus>;
}

/** Latencies, at the subscribed rate. */
export interface LatencyEvent {
  latency_ms: LatencySummary;
}

/** A record of the daemon's log. */
export interface LogEvent {
  level: "info" | "warning" | "error";
  message: string;
  cause: string | null;
  remedy: string | null;
}

/** The link to amplifiers was lost, could not be reopened, or was reopened. Degraded: an amplifier does not reply but may still play; nothing new is played until it replies (restored) or is lost. */
export interface LinkEvent {
  event: "degraded" | "restored" | "lost" | "retry" | "reopened";
  /** its name, if known */
  amplifier: string | null;
  message: string;
  remedy: string | null;
}

/** Another surface layout is in use, or it was replaced; `effects` may have changed with it. */
export interface LayoutEvent {
  /** of the layout in use; null without one */
  name?: string | null;
  /** the surface layout; null without one */
  layout: Record<string, unknown> | null;
}

/** A touch input was opened, fell silent or was lost, or touches were rejected. */
export interface InputsEvent {
  /** all of the configuration */
  inputs: Array<TouchInputStatus>;
  /** number by reason, of all sources */
  rejected_touches: Record<string, number>;
}

/** The rig, as far as drawing it needs. */
export interface RigSummary {
  length_m: number;
  width_m: number;
  eras: Array<EraPosition>;
  /** whether any of its amplifiers is simulated */
  simulated: boolean;
  /** lowest and highest that the rig allows */
  frequency_hz: Array<number>;
}

/** The localization table in use. */
export interface TableSummary {
  /** of the plate and ERAs that it was built for */
  fingerprint: string;
  /** switched or phased */
  mode: string;
  frequencies_hz: Array<number>;
  cells_x: number;
  cells_y: number;
}

/** A finger on the plate and its predicted sensation. */
export interface ContactStatus {
  source: string;
  id: number;
  x_m: number;
  y_m: number;
  /** whether it is to feel the pattern, or only its load counts: of a hand that rests, or of a finger beyond max_fingers; null before the first decision */
  role?: "target" | "quiet" | "hand" | "surplus" | null;
  /** predicted level of a target relative to the rig's threshold set (`threshold` of `status`); null if unknown */
  level_db_sl?: number | null;
  /** felt contrast, target over loudest quiet finger, that nine of ten plates within the rig's uncertainty give; null for a single finger */
  promised_contrast_db?: number | null;
  /** predicted, target over loudest quiet finger; null for a single finger */
  contrast_db?: number | null;
  /** what it is to feel: an effect, if any */
  effect?: string | null;
  /** the effect that it feels: its own, or that of another finger */
  feels?: string | null;
  /** what a target feels: its own, mixed with the contents of others (promised contrast below 12 dB, or these are felt beside one that pauses), the content of another finger, or none */
  verdict?: "own" | "mixed" | "shared" | "held back" | null;
  /** of what it feels, as asked for, which amplifiers may round; null for several */
  frequency_hz?: number | null;
  /** of the contents of others there, which nine of ten plates do not exceed, by the most sensitive thresholds: not to be compared with level_db_sl; null where there are none */
  foreign_level_db_sl?: number | null;
  /** the same level relative to the rig's threshold set, as level_db_sl is */
  rig_foreign_level_db_sl?: number | null;
  /** whether the contents of others may be felt there: foreign_level_db_sl is above 0; beside a verdict own these are weaker by 12 dB or more */
  is_foreign_felt?: boolean;
  /** of the contents of others where it is now, on the nominal plate, relative to the rig's threshold set: more than promised while it moves; in the status only, null where there are none */
  leak_db_sl?: number | null;
  /** why it does not feel an effect of its own, or not its click over what lasts; null if it does */
  held_back?: string | null;
  /** on the plate, relative to the rig's fingertip; 1 where none is reported */
  load?: number;
}

/** Tone of one ERA as confirmed by its amplifier. */
export interface PlayedTone {
  frequency_hz: number;
  /** 0 to 1 of the full stroke */
  level: number;
  phase_deg: number;
}

/** One amplifier according to its last reply; null where unknown. */
export interface AmplifierStatus {
  name: string;
  url: string;
  serial_number: string | null;
  /** its own state, by the names of CiA 402 */
  state: string | null;
  /** the state in a word for people */
  word?: string | null;
  fault: string | null;
  /** 0 to 1 of the full stroke, by channel, as it reports; empty if unknown */
  levels: Array<number>;
  high_voltage: boolean | null;
  /** time since its last reply */
  reply_age_s: number | null;
  /** rms error of its clock against those of the others, as the host sees it; null for one alone, and where it is not held to them */
  clock_skew_us?: number | null;
  /** whether it does not reply but may still play, so that nothing new plays */
  degraded?: boolean;
  /** whether the link to it is lost */
  lost: boolean;
  /** whether it still replied but was closed because another one is lost */
  closed_with_lost: boolean;
  /** what it has reported within the last 10 s */
  reports?: Array<AmplifierReport>;
  /** what it may play while it does not reply; null while it does */
  silence?: AmplifierSilence | null;
  statistics: LinkCounters;
  /** of the amplifier */
  temperature_c: number | null;
  /** of the supply; 0: not measured */
  high_voltage_v: number | null;
}

/** Latency from a touch frame's arrival to the last byte of the resulting command, all in ms. Over the last patterns; median and percentiles are null before the first. */
export interface LatencySummary {
  count: number;
  median: number | null;
  p99: number | null;
  p999: number | null;
  /** [upper edge in ms, number above the previous edge and up to this one]; values above the last edge are counted in the last */
  histogram: Array<[number, number]>;
}

/** A touch input of the configuration: whether touches can come from it. */
export interface TouchInputStatus {
  name: string;
  url: string;
  /** mute: open, but nothing comes although it should; missing: not opened, or lost, and tried again; ended: a recording at its end */
  state: "open" | "mute" | "missing" | "ended";
  /** why it is mute or missing, and what to do; null if it is neither */
  problem?: string | null;
}

/** What an amplifier may play, after a stop or where it does not reply. */
export interface AmplifierSilence {
  /** confirmed by its status after a stop; may play; or unconfirmed, but its watchdog must have silenced it */
  silence: "confirmed_silent" | "may_play" | "watchdog_elapsed";
  /** time until its watchdog must have silenced it; null if that is not known to happen, or if silence is confirmed */
  may_play_for_s: number | null;
  cause: string;
}

/** One finger of a touch frame. */
export interface TouchPoint {
  /** chosen by the client, constant from touch-down to lift */
  id: number;
  /** from the plate's south-west corner */
  x_m: number;
  /** from the plate's south-west corner, upwards */
  y_m: number;
  /** of the contact, where it is known; a hand rests from 12.5 mm on */
  radius_m?: number | null;
}

/** An effect that `play` accepts. */
export interface EffectDescription {
  name: string;
  kind: string;
  description: string;
  /** by their names in a layout, in SI units */
  parameters: Record<string, unknown>;
}

/** Position of an ERA under the plate, from the south-west corner, and its wiring. */
export interface EraPosition {
  name: string;
  x_m: number;
  y_m: number;
  amplifier: string;
  channel: number;
}

/** What an amplifier reports beside a fault, and who feels it; it plays on. */
export interface AmplifierReport {
  /** why it is so */
  cause: string;
  /** what to do about it; null if nothing */
  remedy: string | null;
  kind: "limited" | "interlock_open" | "hot" | "clock_not_steered" | "clock_jumped" | "clock_rate" | "clock_unsettled";
}

/** Counters of the link to an amplifier since it was opened; see the wire protocol. */
export interface LinkCounters {
  frames_out: number;
  frames_in: number;
  /** frames with a wrong checksum, length, form or version */
  invalid_frames: number;
  /** valid but unexpected frames */
  unexpected_frames: number;
  events: number;
  retries: number;
  timeouts: number;
  refusals: number;
  /** of the last request */
  round_trip_ms: number | null;
}
