import type { Arguments, ArmResult, Event, HelloResult, LayoutResult, Method, Methods, StopResult, Topic, TouchPoint } from "./api.js";
export type * from "./api.js";

/** A call that was refused, or that had no response (code 0). */
export class RpcError extends Error {
  code: number;
  remedy: string | null;
}

/** What a page is told; connection.js says when. */
export interface Handlers {
  opened?(hello: HelloResult, name: string): void;
  closed?(): void;
  failed?(why: "daemon" | "refused" | "full" | "unreachable"): void;
  event?(event: Event): void;
  disarmed?(): void;
  stopped?(result: StopResult): void;
  lifted?(): void;
  field?(field: ArrayBuffer): void;
}

/** The plate over the gateway's WebSocket, connected again after every loss. */
export class Connection {
  constructor(token: string, topics: Topic[], handlers: Handlers, gateway?: string | URL, source?: string | null);
  readonly isOpen: boolean;
  readonly lease: ArmResult["lease"] | null;
  call<M extends Method>(method: M, ...params: Arguments<M>): Promise<Methods[M]["result"]>;
  arm(owner: string): Promise<void>;
  disarm(): Promise<unknown>;
  layout(name: string): Promise<LayoutResult>;
  touch(touches: TouchPoint[]): void;
  lift(): void;
  strength(name: string, gain_db?: number | null): Promise<number>;
  stop(): Promise<StopResult>;
  close(): void;
}
